"""Which cases each tier asks for: designs of the generator of `benchmarks.renewed`."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.renewed import ranges
from benchmarks.renewed.cases import Case, agree, in_world, make_case, seeded, turn, write_sealed
from benchmarks.renewed.forms import EFFECTS, FORM, INSIDE, OUTSIDE
from benchmarks.renewed.forms.further import inverse_amplitude, knee, trefoil
from benchmarks.renewed.geometry import Random, inverse, small_motions
from benchmarks.renewed.ranges import Range
from benchmarks.renewed.recording import Recorded, depth_over_range, record
from benchmarks.renewed.signal_chain import Form
from benchmarks.renewed.world import session_again
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
        fault: What is done to the recording after the camera.
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
    fault: Callable[[Random, Recorded], Recorded] | None = None
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


def _several(index: int, rng: Random) -> Draw:
    while True:
        forms = tuple(FORMS[i] for i in rng.choice(len(FORMS), 2 + index % 2, replace=False))
        if agree(forms):
            return Draw(forms, Range(2.0, 12.0, log=True))


def _left_out(index: int, rng: Random) -> Draw:
    name = _one(index)[0].effect
    return Draw(_one(index), LARGE, exclude=(name, *HOLDERS.get(name, ())))


def _confounded(index: int, rng: Random) -> Draw:
    design, names = CONFOUNDED[index % len(CONFOUNDED)]
    name = names[index // len(CONFOUNDED) % len(names)]
    cure, about = {key: SOUND[key] for key in design}, {"lacks": [*design]}
    return Draw((FORM[name],), LARGE, design, partner=cure, role="cured", about=about)


def _missing(index: int, rng: Random) -> Draw:
    name, without, judged = MISSING[index % len(MISSING)]
    return Draw((FORM[name],), LARGE, without=without, judged=judged)


def _noise(index: int, rng: Random) -> Draw:
    kind, changed = list(NOISES.items())[index // 2 % len(NOISES)]
    forms = _one(index // 2) if index % 2 else ()
    return Draw(forms, ranges=changed, about={"noise": kind})


def _base(index: int, rng: Random) -> Draw:
    own = (knee, trefoil, inverse_amplitude)[index // 2 % 3]
    others = [name for name in EFFECTS if name != own.effect]
    forms = (own, *_one(index // 2, others)) if index % 2 else (own,)
    return Draw(forms, Range(3.0, 6.0), about={"base": own.effect})


# The cases of an audit.

BOARD = (1e-3, 2e-3)  # metres and radians, each axis: errors of a board's pose
OFF_SHARE, OFF_BY = 0.03, 0.7  # of the pixels; metres


def far_pixels(rng: Random, recorded: Recorded) -> Recorded:
    """Single pixels are far off, and the mask has them."""
    off = rng.uniform(size=recorded.depth.shape) < OFF_SHARE
    depth = recorded.depth + off * OFF_BY * depth_over_range(recorded.world)
    return replace(recorded, depth=depth)


def board_planes(rng: Random, recorded: Recorded) -> Recorded:
    """No robot: each pose's plane comes from the picture of a board, with its errors."""
    world = recorded.world
    draws = (size * rng.standard_normal((world.way.poses, 3)) for size in BOARD)
    true = inverse(world.world_from_tool() @ world.tool_from_camera) @ world.world_from_target
    still = np.broadcast_to(np.eye(4), true.shape)
    board = small_motions(*draws)[world.way.pose_id] @ true
    guess = replace(world, guess=np.eye(4))
    return replace(recorded, world=guess, stated_poses=still, stated_target=board)


NO_AMPLITUDE: dict[str, Any] = {"without": ("amplitude.npy",)}
OUTLIERS = {"says": "outliers"}  # a warning that must be there
WIDE_IMAGE = {"ranges": {"images": {(224, 172): 1.0}, "frames": {40: 1.0}}}
AUDIT: dict[str, tuple[str, dict[str, Any]]] = {
    "multipath, weight falls with height": ("above_floor", {"sizes": Range(6.0, 20.0, log=True)}),
    "stray light, 172x224": ("spread veil ghost", WIDE_IMAGE),
    "noise of a filter, nothing missing": ("", {"ranges": NOISES["a filter"]}),
    "robot 2 mm, nothing missing": ("", {"ranges": NOISES["a worse robot"]}),
    "board poses 1 mm / 2 mrad, no robot, nothing missing": (
        "",
        {"ranges": {"robot_mm": Range(0.0, 0.0)}, "fault": board_planes},
    ),
    "3 % of the pixels 0.7 m off": ("", {"fault": far_pixels, "about": OUTLIERS}),
    "wiggling, no amplitude, varied exposure": ("odd_harmonics", NO_AMPLITUDE),
    "the same before a white wall": (
        "odd_harmonics",
        NO_AMPLITUDE | {"ranges": {"targets": {"white": 1.0}}},
    ),
    "wiggling times amplitude": ("wiggle_of_dark", {}),
    "30 frames": (
        "odd_harmonics driver_droop halves_and_pairs two_exponentials veil",
        {"ranges": {"frames": {30: 1.0}}},
    ),
    "200 frames of warm-up": (
        "two_exponentials line_with_pauses",
        {"ranges": {"frames": {200: 1.0}}},
    ),
    "0.5 to 6 m": ("odd_harmonics duty_cycle", {"ranges": {"farthest_times": Range(12.0, 12.0)}}),
    "two effects": (
        "odd_harmonics+logarithm halves_and_pairs+two_exponentials clear_layer+driver_droop",
        {},
    ),
    "172x224, nothing missing": ("", WIDE_IMAGE),
    "a bracket that sags with the roll": ("sagging_bracket", {}),
    "board edges, true footprints": (
        "aperture",
        {"wanted": {"mask": "all that is seen"}, "about": OUTLIERS},
    ),
    "rendered wall, floor, side wall": ("rendered_corner", {}),
    "rendered bright room": ("bright_room", {}),
}
"""Forms of each draw in turn, those of one draw joined by +; and what else differs."""


def _audit(index: int, rng: Random) -> Draw:
    row, (names, changes) = list(AUDIT.items())[index % len(AUDIT)]
    turns = names.split() or [""]
    joined = turns[index // len(AUDIT) % len(turns)]
    forms = tuple(FORM[name] for name in joined.split("+") if name)
    draw = Draw(forms, **{"sizes": Range(4.0, 10.0, log=True), **changes})  # type: ignore[arg-type]
    return replace(draw, about={"row": row, "says": "", **draw.about})


TIERS: dict[str, Callable[[int, Random], Draw]] = {
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
    "L": _audit,
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
        if draw.fault is not None:
            case = replace(case, recorded=draw.fault(rng, case.recorded))
        entry = write_sealed(rng, case, out, about, {"role": "main", "index": index}, draw.without)
        yield entry | {"exclude": [*draw.exclude]}
        if draw.partner is not None:
            world = session_again(rng, case.world, **draw.partner)
            hooks = in_world(world, case.hooks)
            again = Case(world, hooks, *record(rng, world, hooks))
            role = {"role": draw.role, "index": index, "main": entry["id"]}
            yield write_sealed(rng, again, out, about, role)
