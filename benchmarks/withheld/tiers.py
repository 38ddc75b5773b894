"""Which cases each tier asks for: designs of the generator of `benchmarks.renewed`."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.renewed import ranges
from benchmarks.renewed.cases import Case, agree, in_world, make_case, seeded, turn, write_sealed
from benchmarks.renewed.forms import EFFECTS, FORM, INSIDE, OUTSIDE
from benchmarks.renewed.geometry import Array
from benchmarks.renewed.ranges import Range
from benchmarks.renewed.recording import record
from benchmarks.renewed.signal_chain import Change, Form, View, form
from benchmarks.renewed.world import World, session_again
from benchmarks.sealed.answers import Entry

# Effects of the program's catalogue that hold another one as a special case: a catalogue without
# the other must do without them too. A free curve of the distance holds every wiggle, a constant of
# every pixel those of rows and columns, the time of the first sample an offset of the stamps.
HOLDERS = {
    "wiggling": ("distance",),
    "row_column_pattern": ("fixed_pattern",),
    "timestamp_offset": ("motion",),
}
FORMS = tuple(one for one in INSIDE if one.scaled and one.name != "rendered_slab")
TEXTBOOK = {one.effect: one for one in reversed(FORMS) if one.textbook}
USUAL, LARGE = Range(0.5, 16.0, log=True), Range(2.0, 16.0, log=True)


@form("distance", "path", 0.005)
def knee(rng: np.random.Generator, world: World) -> Change:
    """The error has a knee in distance."""
    at = rng.uniform(0.3, 0.7) * (world.design.near + world.design.far)
    return lambda strength, view, path: path + strength * np.abs(view.distance - at)


@form("pixel", "path", 0.005)
def trefoil(rng: np.random.Generator, world: World) -> Change:
    """The error over the image is a trefoil."""
    column, row = world.pixel_position
    wave = np.hypot(column, row) ** 3 * np.cos(3 * np.arctan2(row, column) + rng.uniform(0, 6))
    return lambda strength, view, path: path + strength * wave


@form("amplitude", "path", 0.0005)
def inverse_amplitude(rng: np.random.Generator, world: World) -> Change:
    """The error goes with one over the amplitude."""

    def change(strength: float, view: View, path: Array) -> Array:
        return path + strength * np.minimum(view.bright / view.amplitude, 50.0)

    return change


@dataclass(frozen=True)
class Draw:
    """What one case is made of.

    Attributes:
        forms: Effects in it.
        sizes: RMS of each over the pixels on the target, mm.
        wanted: What the design must be like, beyond what the forms want.
        ranges: What differs from the plain laboratory.
        without: Columns and files that are not written.
        judged: Whether the effect can be judged without these.
        exclude: What the catalogue must do without.
        partner: The design of another session of the same camera; None: there is none.
        role: Of that session: `fresh`, or `cured`.
        about: What the answer says besides.
    """

    forms: tuple[Form, ...] = ()
    sizes: Range = USUAL
    wanted: Mapping[str, Any] = field(default_factory=dict)
    ranges: Mapping[str, Any] = field(default_factory=dict)
    without: tuple[str, ...] = ()
    judged: bool = True
    exclude: tuple[str, ...] = ()
    partner: Mapping[str, Any] | None = None
    role: str = ""
    about: Mapping[str, Any] = field(default_factory=dict)


CONFOUNDED: tuple[tuple[dict[str, Any], tuple[str, ...]], ...] = (
    ({"exposure": "constant"}, ("logarithm", "bias_shift", "dark_power_law")),
    ({"exposure": "automatic"}, ("logarithm", "clear_layer", "dark_power_law")),
    ({"tilt": 0.0}, ("clear_layer", "barrel", "misplaced", "scale")),
    ({"target": "white"}, ("dark_power_law", "spread", "clipped", "clear_layer")),
)
SOUND = {"exposure": "random", "tilt": float(np.deg2rad(30.0)), "target": "both"}
MISSING: tuple[tuple[str, tuple[str, ...], bool], ...] = (  # what is withheld; judged all the same
    ("logarithm", ("integration_time_us",), False),
    ("lag", ("room_temperature_c", "body_temperature_c"), False),
    ("bias_shift", ("ambient",), False),
    ("spread", ("amplitude.npy",), False),
    ("two_exponentials", ("body_temperature_c",), True),
    ("odd_harmonics", ("modulation_frequency_hz",), False),
    ("every_pixel", ("pose_id", "ambient", "body_temperature_c", "room_temperature_c"), True),
)
NOISES: dict[str, dict[str, Any]] = {
    "heavy tails": {"tails": {3.0: 1.0}},
    "a filter": {"spatial_filter": {"mean of 3x3": 0.5, "gauss of 1.2 pixels": 0.5}},
    "frames mixed": {"temporal_filter": {0.7: 1.0}, "repeated": {0.35: 1.0}},
    "sunlight": {"outdoor": 1.0},
    "a worse robot": {"robot_mm": Range(2.0, 2.0)},
}


def _one(index: int, names: Sequence[str] = EFFECTS) -> tuple[Form, ...]:
    effects = [TEXTBOOK[name] for name in names if name in TEXTBOOK]
    return (turn(0, effects, index),)


def _several(index: int, rng: np.random.Generator) -> Draw:
    while True:
        forms = tuple(FORMS[i] for i in rng.choice(len(FORMS), 2 + index % 2, replace=False))
        if agree(forms):
            return Draw(forms, Range(2.0, 12.0, log=True))


def _left_out(index: int, rng: np.random.Generator) -> Draw:
    name = _one(index)[0].effect
    return Draw(_one(index), LARGE, exclude=(name, *HOLDERS.get(name, ())))


def _confounded(index: int, rng: np.random.Generator) -> Draw:
    design, names = CONFOUNDED[index % len(CONFOUNDED)]
    name = names[index // len(CONFOUNDED) % len(names)]
    cure = {key: SOUND[key] for key in design}
    return Draw(
        (FORM[name],), LARGE, design, partner=cure, role="cured", about={"lacks": [*design]}
    )


def _missing(index: int, rng: np.random.Generator) -> Draw:
    name, without, judged = MISSING[index % len(MISSING)]
    return Draw((FORM[name],), LARGE, without=without, judged=judged)


def _noise(index: int, rng: np.random.Generator) -> Draw:
    kind, changed = list(NOISES.items())[index // 2 % len(NOISES)]
    forms = _one(index // 2) if index % 2 else ()
    return Draw(forms, ranges=changed, about={"noise": kind})


def _base(index: int, rng: np.random.Generator) -> Draw:
    own = (knee, trefoil, inverse_amplitude)[index // 2 % 3]
    others = [name for name in EFFECTS if name != own.effect]
    forms = (own, *_one(index // 2, others)) if index % 2 else (own,)
    return Draw(forms, Range(3.0, 6.0), about={"base": own.effect})


TIERS: dict[str, Callable[[int, np.random.Generator], Draw]] = {
    "A": lambda index, rng: Draw(
        _one(index), partner={"frames": 120} if index % 2 else None, role="fresh"
    ),
    "B": _several,
    "C": lambda index, rng: Draw(_one(index // 4) if index % 4 == 3 else (), Range(0.2, 0.2)),
    "D": lambda index, rng: Draw((turn(0, OUTSIDE, index),), Range(1.0, 16.0, log=True)),
    "E": _left_out,
    "F": _confounded,
    "G": _missing,
    "H": lambda index, rng: Draw(_one(index // 3), wanted={"frames": (15, 30, 60)[index % 3]}),
    "I": _noise,
    "J": _base,
}


def write_case(seed: int, tier: str, index: int, out: Path) -> Iterator[Entry]:
    """Write one case, with its partner if it has one; yield the manifest's entries.

    It depends on seed, tier and index alone.
    """
    rng = np.random.default_rng([seed, 5, list(TIERS).index(tier), index])
    draw = TIERS[tier](index, rng)
    about = {"tier": tier, "judged": draw.judged, **draw.about}
    with ranges.drawn_from(**{**ranges.PLAIN, **draw.ranges}):
        forms = seeded(draw.forms, int(rng.integers(2**32)))
        case = make_case(rng, forms, draw.sizes, draw.wanted)
        entry = write_sealed(rng, case, out, about, {"role": "main", "index": index}, draw.without)
        yield entry | {"exclude": [*draw.exclude]}
        if draw.partner is not None:
            world = session_again(rng, case.world, **draw.partner)
            hooks = in_world(world, case.hooks)
            again = Case(world, hooks, *record(rng, world, hooks))
            role = {"role": draw.role, "index": index, "main": entry["id"]}
            yield write_sealed(rng, again, out, about, role)
