"""The error over what is known of a frame, such as its integration time, and these conditions."""

from collections.abc import Mapping, Sequence
from typing import ClassVar, Literal

import torch
from pydantic import Field, PositiveFloat, PositiveInt
from torch import Tensor

from tofcorr.conditions import CONDITIONS, condition
from tofcorr.error_terms.base import BaseTermOptions, ConditionTerm, Domain, powers
from tofcorr.errors import FrameError


class IntegrationTimeOptions(BaseTermOptions):
    """Options of a `ConditionPolynomial` in the integration time."""

    kind: Literal["integration_time"] = "integration_time"
    degree: PositiveInt = Field(default=1, le=5)
    needs: ClassVar[tuple[str, ...]] = ("integration_time",)
    letter: ClassVar[str] = "e"


class RoomTemperatureOptions(BaseTermOptions):
    """Options of a `ConditionPolynomial` in the room's temperature."""

    kind: Literal["room_temperature"] = "room_temperature"
    degree: PositiveInt = Field(default=1, le=5)
    needs: ClassVar[tuple[str, ...]] = ("room_temperature",)
    letter: ClassVar[str] = "h"


class AmbientLightOptions(BaseTermOptions):
    """Options of a `ConditionPolynomial` in the background light."""

    kind: Literal["ambient_light"] = "ambient_light"
    degree: PositiveInt = Field(default=1, le=5)
    needs: ClassVar[tuple[str, ...]] = ("ambient",)
    letter: ClassVar[str] = "b"


class ConditionPolynomial(ConditionTerm):
    r"""Polynomial in one condition of a frame.

    .. math:: E(u) = \sum_{k=1}^{K} h_k u^k, \quad u = (x - \bar x) / w

    with x the integration time, the room's temperature or the background light, clamped to its
    calibrated range. Kahlmann, Remondino and Ingensand (2006) measured all three: the error changes
    with the integration time, and by about 8 mm a degree Celsius.

    Args:
        options: The degree.
        domain: Mean and range of the condition.

    Raises:
        CalibrationDataError: The condition is not known of every frame.

    Shape:
        - Input: `(*, C)`, conditions in the order of `CONDITIONS`.
        - Output: `(*)`, predicted errors in metres.
    """

    half_width: Tensor

    def __init__(
        self,
        options: IntegrationTimeOptions | RoomTemperatureOptions | AmbientLightOptions,
        domain: Domain,
    ) -> None:
        names = [f"{options.letter}{k}" for k in range(1, options.degree + 1)]
        super().__init__(options, names, options.needs[0], domain)
        self.degree: int = options.degree
        # A condition that did not change has no scale: any number does.
        self.register_number("half_width", float(self.high - self.low) / 2 or 1.0)

    def basis(self, conditions: Tensor) -> Tensor:
        """Return u, u^2, ..., shape (K, ...)."""
        return powers((self.value(conditions) - self.mean) / self.half_width, self.degree)


class WarmUpOptions(BaseTermOptions):
    """Options of `WarmUp`.

    Attributes:
        time_constants_s: Time constants of the exponentials, seconds; `auto` finds one in the data.
    """

    kind: Literal["warm_up"] = "warm_up"
    time_constants_s: Literal["auto"] | tuple[PositiveFloat, ...] = "auto"
    needs: ClassVar[tuple[str, ...]] = ("timestamp",)
    found_in_data: ClassVar[tuple[str, ...]] = ("time_constants_s",)


class WarmUp(ConditionTerm):
    r"""Drift of a camera that warms up: exponentials in the time since the recording began.

    .. math:: E(t) = \sum_k w_k \left(e^{-t / \tau_k} - e^{-\bar t / \tau_k}\right)

    Kahlmann et al. (2006) saw distances settle within minutes after power on. The amplitudes w_k
    are coefficients; the fit finds the time constants.

    Args:
        options: The time constants; `auto` starts at a third of the recording.
        domain: Mean and range of the time.

    Shape:
        - Input: `(*, C)`, conditions in the order of `CONDITIONS`.
        - Output: `(*)`, predicted errors in metres.
    """

    rates: Tensor

    def __init__(self, options: WarmUpOptions, domain: Domain) -> None:
        chosen = options.time_constants_s
        number = 1 if chosen == "auto" else len(chosen)
        names = [f"w{k}" for k in range(1, number + 1)]
        super().__init__(options, names, "timestamp", domain)
        span = float(self.high - self.low)
        # Until a fit finds one: three make up the recording, after which 5 % of the drift is left.
        constants = (max(span, 1.0) / 3,) if chosen == "auto" else chosen
        self.register_buffer("rates", 1.0 / torch.tensor(constants, dtype=torch.float64))

    def basis(self, conditions: Tensor) -> Tensor:
        """Return each exponential less its value at the mean time, shape (K, ...)."""
        time = self.value(conditions).unsqueeze(-1)
        decay = torch.exp(-time * self.rates) - torch.exp(-self.mean * self.rates)
        return decay.movedim(-1, 0)


Condition = float | Tensor | None
"""One number for all frames, or one for each: shape (...) of depth (..., H, W); None: unknown."""

NAME_OF = {condition(name).column: name for name in CONDITIONS}
"""The attribute of `Conditions` by the column of `frames.csv`."""


def in_si_units(
    given: Mapping[str, Condition], frames: Sequence[int], dtype: torch.dtype, device: torch.device
) -> dict[str, Tensor]:
    """Return the conditions that are given, by attribute of `Conditions`, in its units.

    Args:
        given: By column of `frames.csv`, in the units of the columns.
        frames: The leading shape (...) of the depth (..., H, W).
        dtype: Of the result.
        device: Of the result.

    Returns:
        Tensors of shape () or (...), as they were given; NaN: unknown of that frame.

    Raises:
        FrameError: There is no such condition, or it has neither one value nor one a frame.
    """
    known = {}
    for column, value in given.items():
        if column not in NAME_OF:
            raise FrameError(f"'{column}' is no condition of a frame. Known: {', '.join(NAME_OF)}.")
        if value is None:
            continue
        number = torch.as_tensor(value, device=device).to(dtype)
        if number.dim() and list(number.shape) != list(frames):
            shapes = f"one for each frame, shape {list(frames)}; got {list(number.shape)}"
            raise FrameError(f"{column}: expected one number, or {shapes}.")
        name = NAME_OF[column]
        known[name] = number * condition(name).si_per_unit
    return known


def with_means(known: Mapping[str, Tensor], mean: Tensor) -> Tensor:
    """Return the conditions in the order of `CONDITIONS`; what is unknown is taken as the mean.

    Args:
        known: As `in_si_units` returns them.
        mean: The mean conditions of the calibration, shape (C,).

    Returns:
        Shape (..., C), or (C,) if none was given for each frame; dtype and device of `mean`.
    """
    values = []
    for name, usual in zip(CONDITIONS, mean.unbind(-1), strict=True):
        value = known[name].to(mean.dtype) if name in known else usual
        values.append(torch.where(torch.isnan(value), usual, value))
    return torch.stack(torch.broadcast_tensors(*values), dim=-1)
