"""The conditions of a frame: each one is named here, once.

A condition is what is known of the circumstances of a frame beside its images, its pose and its
target. Adding one means a field of `Conditions` and a line below it: `frames.csv`, frame batches,
the simulator and the effects then carry it. A model term or an effect that uses it names it as what
it needs.
"""

from dataclasses import dataclass
from typing import Any, Generic, TypeVar

Value = TypeVar("Value")


@dataclass(frozen=True)
class Condition:
    """What one condition is called, and its unit in files.

    Attributes:
        name: Attribute of `Conditions`, always in SI units or degrees Celsius.
        column: Column of `frames.csv`, and keyword of `DepthCorrector.set_conditions`.
        unit: Unit of the column, for axis labels.
        si_per_unit: Value of one unit of the column in the unit of the attribute.
        words: What it is called in a sentence.
        covariate: Name in `diagnosis.json`.
        column_rank: Order of the optional columns in `frames.csv`. It differs from the order of
            `CONDITIONS` because both orders are part of files that exist.
        required: Whether every recording has it.
        positive: Whether zero and negative values are errors.
    """

    name: str
    column: str
    unit: str
    words: str
    covariate: str
    si_per_unit: float = 1.0
    column_rank: int = 0
    required: bool = False
    positive: bool = False

    @property
    def label(self) -> str:
        """Label of an axis: words and unit of the column."""
        return f"{self.words}, {self.unit}"

    def in_file(self, values: Any) -> Any:  # noqa: ANN401 - a number, an array or a tensor
        """Return values in the unit of the column."""
        return values * (1.0 / self.si_per_unit)


@dataclass(frozen=True, kw_only=True, eq=False)
class Conditions(Generic[Value]):
    """The conditions of one frame (numbers) or of many (arrays, tensors); None means unknown.

    Attributes:
        timestamp: Time since the recording began, seconds.
        integration_time: Exposure of the pixels, seconds.
        room_temperature: Degrees Celsius.
        body_temperature: Temperature of the camera's body, degrees Celsius.
        ambient: Background light in the camera's own linear units (those of the amplitude).
    """

    timestamp: Value
    integration_time: Value | None = None
    room_temperature: Value | None = None
    body_temperature: Value | None = None
    ambient: Value | None = None

    def by_name(self) -> dict[str, Any]:
        """Return the conditions by name, in the order of `CONDITIONS`."""
        return {name: getattr(self, name) for name in CONDITIONS}


_INTEGRATION = ("integration_time", "integration_time_us", "µs")
_ROOM = ("room_temperature", "room_temperature_c", "C", "room temperature", "room_temperature_c")
_BODY = ("body_temperature", "body_temperature_c", "C", "body temperature", "body_temperature_c")
_ALL = (
    Condition("timestamp", "timestamp_s", "s", "time", "timestamp_s", required=True),
    Condition(*_INTEGRATION, "integration time", "integration_time", 1e-6, 1, positive=True),
    Condition(*_ROOM, column_rank=3),
    Condition(*_BODY, column_rank=2),
    Condition("ambient", "ambient", "counts", "background light", "ambient", column_rank=4),
)
_BY_NAME = {each.name: each for each in _ALL}
CONDITIONS: tuple[str, ...] = tuple(_BY_NAME)
"""Names of the conditions, in the order of every conditions tensor."""

OPTIONAL_CONDITIONS: tuple[Condition, ...] = tuple(
    sorted((c for c in _ALL if not c.required), key=lambda c: c.column_rank)
)
"""The conditions that a recording may lack, in the order of their columns in `frames.csv`."""


def condition(name: str) -> Condition:
    """Return the condition of this name.

    Raises:
        KeyError: There is no such condition.
    """
    return _BY_NAME[name]
