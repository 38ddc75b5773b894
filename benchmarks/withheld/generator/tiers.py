"""Which cases each tier asks for."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from benchmarks.withheld.generator.base_errors import BASE_FORMS
from benchmarks.withheld.generator.catalogue import INSIDE, NEEDS_MOTION, OUTSIDE
from benchmarks.withheld.generator.noise import NOISES
from benchmarks.withheld.generator.poses import Design

LARGEST_MM = {"motion": 8.0}  # beyond, the taps would have to be tenths of a second apart

CONFOUNDED: tuple[tuple[Design, tuple[str, ...]], ...] = (
    (Design(exposure="constant"), ("integration_time", "ambient_light", "amplitude")),
    (Design(exposure="automatic"), ("integration_time", "incidence_angle", "amplitude")),
    (Design(order="sorted"), ("warm_up", "room_temperature", "wiggling")),
    (Design(tilt=False), ("incidence_angle", "lens", "target_registration", "robot_kinematics")),
    (Design(targets="white"), ("amplitude", "stray_light", "saturation", "incidence_angle")),
)

MISSING: tuple[
    tuple[str, frozenset[str], bool], ...
] = (  # effect, what is withheld, whether it can still be judged
    ("integration_time", frozenset({"integration_time_us"}), False),
    ("room_temperature", frozenset({"room_temperature_c", "body_temperature_c"}), False),
    ("ambient_light", frozenset({"ambient"}), False),
    ("stray_light", frozenset({"amplitude.npy"}), False),
    ("warm_up", frozenset({"body_temperature_c"}), True),
    ("wiggling", frozenset({"modulation_frequency_hz"}), False),
    (
        "fixed_pattern",
        frozenset({"pose_id", "ambient", "body_temperature_c", "room_temperature_c"}),
        True,
    ),
)


# Effects of the program's catalogue that hold another one as a special case: a catalogue without
# the other must do without them too. A free curve of the distance holds every wiggle, a constant of
# every pixel those of rows and columns, the time of the first sample an offset of the stamps.
HOLDERS = {
    "wiggling": ("distance",),
    "row_column_pattern": ("fixed_pattern",),
    "timestamp_offset": ("motion",),
}


@dataclass(frozen=True)
class Case:
    """What one case is made of; sizes in millimetres RMS of raw depth."""

    tier: str
    effects: tuple[tuple[str, float], ...] = ()
    design: Design = field(default_factory=Design)
    noise: str = "usual"
    wrong_base: str = "smooth"
    withhold: frozenset[str] = frozenset()
    can_be_judged: bool = True
    exclude: tuple[str, ...] = ()
    partner: str = ""  # "fresh": the setup recorded again; "cured": again, by a sound design


def draw_case(tier: str, index: int, rng: np.random.Generator) -> Case:
    """Draw case number `index` of a tier; effects take turns, the rest is chance."""
    if tier not in TIERS:
        raise ValueError(f"no tier {tier!r}: expected some of {', '.join(TIERS)}")
    return TIERS[tier](index, rng)


def _size(rng: np.random.Generator, name: str, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(min(high, LARGEST_MM.get(name, high))))))


def _turn(names: tuple[str, ...], index: int) -> str:
    """Every name once in each round, in an order of its own every round."""
    order = np.random.default_rng([len(names), index // len(names)]).permutation(len(names))
    return names[order[index % len(names)]]


def _design(rng: np.random.Generator, names: tuple[str, ...], frames: int = 60) -> Design:
    moving = bool(NEEDS_MOTION & set(names)) or rng.uniform() < 0.12
    repeats = 0 if moving or rng.uniform() < 0.35 else max(frames // 10, 2)
    return Design(frames=frames, moving=moving, repeats=repeats)


def _one(
    index: int, rng: np.random.Generator, tier: str, low: float, high: float, frames: int = 60
) -> Case:
    name = _turn(tuple(INSIDE), index)
    return Case(tier, ((name, _size(rng, name, low, high)),), _design(rng, (name,), frames))


def _single(index: int, rng: np.random.Generator) -> Case:
    return replace(_one(index, rng, "A", 0.5, 16.0), partner="fresh" if index % 2 else "")


def _several(index: int, rng: np.random.Generator) -> Case:
    names = tuple(rng.choice(list(INSIDE), size=2 + index % 2, replace=False).tolist())
    return Case(
        "B", tuple((name, _size(rng, name, 2.0, 12.0)) for name in names), _design(rng, names)
    )


def _nothing(index: int, rng: np.random.Generator) -> Case:
    """Three in four are well specified; the fourth has an effect of 0.2 mm."""
    if index % 4 < 3:
        return Case("C", (), _design(rng, ()))
    name = _turn(tuple(INSIDE), index // 4)
    return Case("C", ((name, 0.2),), _design(rng, (name,)))


def _outside(index: int, rng: np.random.Generator) -> Case:
    name = _turn(tuple(OUTSIDE), index)
    return Case("D", ((name, _size(rng, name, 1.0, 16.0)),), _design(rng, (name,)))


def _left_out(index: int, rng: np.random.Generator) -> Case:
    case = _one(index, rng, "E", 2.0, 16.0)
    name = case.effects[0][0]
    return replace(case, exclude=(name, *HOLDERS.get(name, ())))


def _confounded(index: int, rng: np.random.Generator) -> Case:
    design, names = CONFOUNDED[index % len(CONFOUNDED)]
    name = names[index // len(CONFOUNDED) % len(names)]
    repeats = int(rng.choice([0, 6]))
    return Case(
        "F",
        ((name, _size(rng, name, 2.0, 16.0)),),
        replace(design, repeats=repeats),
        partner="cured",
    )


def _columns_missing(index: int, rng: np.random.Generator) -> Case:
    name, withhold, can_be_judged = MISSING[index % len(MISSING)]
    effects = ((name, _size(rng, name, 2.0, 16.0)),)
    return Case("G", effects, _design(rng, (name,)), withhold=withhold, can_be_judged=can_be_judged)


def _few_frames(index: int, rng: np.random.Generator) -> Case:
    return _one(index // 3, rng, "H", 1.0, 16.0, frames=(15, 30, 60)[index % 3])


def _other_noise(index: int, rng: np.random.Generator) -> Case:
    kinds = [kind for kind in NOISES if kind != "usual"]
    case = _one(index // 2, rng, "I", 1.0, 16.0)
    return replace(
        case, effects=case.effects if index % 2 else (), noise=kinds[index // 2 % len(kinds)]
    )


def _other_base(index: int, rng: np.random.Generator) -> Case:
    forms = [form for form in BASE_FORMS if form != "smooth"]
    case = _one(index // 2, rng, "J", 1.0, 16.0)
    return replace(
        case, effects=case.effects if index % 2 else (), wrong_base=forms[index // 2 % len(forms)]
    )


TIERS: dict[str, Callable[[int, np.random.Generator], Case]] = {
    "A": _single,
    "B": _several,
    "C": _nothing,
    "D": _outside,
    "E": _left_out,
    "F": _confounded,
    "G": _columns_missing,
    "H": _few_frames,
    "I": _other_noise,
    "J": _other_base,
}
