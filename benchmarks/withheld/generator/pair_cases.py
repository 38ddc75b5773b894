"""Which pairs of a camera and a simulator each kind asks for."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from benchmarks.withheld.generator.catalogue import INSIDE, NEEDS_MOTION
from benchmarks.withheld.generator.poses import Design
from benchmarks.withheld.generator.tiers import LARGEST_MM

TERMS = ("distance", "pixel", "amplitude")
FIXED_MM = 5.0  # size of the withheld effect where it is stated, RMS of raw depth
RANGE_MM = (2.0, 12.0)  # log-uniform where it is not
NOISE_FACTORS = (1.0, 0.5, 2.0, 0.0)  # of the simulator's noise over the camera's
DROPOUT_SHARES = (0.003, 0.05)  # log-uniform, of the pixels on the target


@dataclass(frozen=True)
class PairCase:
    """What one pair is made of; sizes in millimetres RMS of raw depth.

    `withheld` is in the camera alone, `shared` in both; `terms` are the camera's base errors that
    the simulator has as well. `noise` is the simulator's noise over the camera's; `amplitude_gain`
    the camera's amplitude over the simulator's. `dropouts` are shares of the pixels on the target:
    the camera's and the simulator's.
    """

    tier: str
    withheld: tuple[tuple[str, float], ...] = ()
    shared: tuple[tuple[str, float], ...] = ()
    terms: tuple[str, ...] = ()
    design: Design = field(default_factory=Design)
    other_poses: bool = False
    hand_eye_off: bool = False
    noise: float = 0.0
    dropouts: tuple[float, float] = (0.0, 0.0)
    dark_dropouts: bool = False  # dark pixels drop out rather than bright ones
    amplitude_gain: float = 1.0
    held_out: bool = False  # with ideal frames at poses of their own, to be degraded
    renderer: str = ""  # "pybullet": its z-buffer instead of the generator's geometry

    @property
    def ideal(self) -> bool:
        """Whether the simulator writes depth alone, without amplitude and conditions."""
        return not self.terms and not self.shared


def draw_pair(kind: str, index: int, rng: np.random.Generator) -> PairCase:
    """Draw case number `index` of a kind; effects take turns, the rest is chance."""
    if kind not in KINDS:
        raise ValueError(f"no kind of pair {kind!r}: expected some of {', '.join(KINDS)}")
    return KINDS[kind](index, rng)


def _turn(index: int, kind: str) -> str:
    """Every effect once in each round, in an order of its own every round and kind."""
    names = tuple(INSIDE)
    seed = [*kind.encode(), index // len(names)]
    return names[np.random.default_rng(seed).permutation(len(names))[index % len(names)]]


def _drawn(rng: np.random.Generator, name: str) -> tuple[str, float]:
    low, high = RANGE_MM[0], min(RANGE_MM[1], LARGEST_MM.get(name, RANGE_MM[1]))
    return name, float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _design(*names: str) -> Design:
    moving = bool(NEEDS_MOTION & set(names))
    return Design(moving=moving, repeats=0 if moving else 6)


def _ideal(index: int, rng: np.random.Generator) -> PairCase:
    del rng
    name = _turn(index, "ideal")
    design = _design(name)
    return PairCase("ideal", ((name, FIXED_MM),), design=design, held_out=not design.moving)


def _no_effect(index: int, rng: np.random.Generator) -> PairCase:
    del index, rng
    return PairCase("no_effect", design=_design(), held_out=True)


def _hand_eye(index: int, rng: np.random.Generator) -> PairCase:
    del rng
    name = _turn(index, "hand_eye")
    return PairCase("hand_eye", ((name, FIXED_MM),), design=_design(name), hand_eye_off=True)


def _terms(index: int, rng: np.random.Generator) -> PairCase:
    effect = _drawn(rng, _turn(index, "terms"))
    return PairCase(
        "terms",
        (effect,),
        terms=("distance", "pixel"),
        design=_design(effect[0]),
        noise=NOISE_FACTORS[index % 4],
    )


def _shared(index: int, rng: np.random.Generator) -> PairCase:
    withheld = _turn(index, "shared")
    others = [name for name in INSIDE if name != withheld]
    common = others[rng.integers(len(others))]
    return PairCase(
        "shared",
        (_drawn(rng, withheld),),
        (_drawn(rng, common),),
        TERMS,
        _design(withheld, common),
        noise=1.0,
    )


def _nothing(index: int, rng: np.random.Generator) -> PairCase:
    """Every second pair shares an effect as well."""
    names = (_turn(index // 2, "nothing"),) if index % 2 else ()
    return PairCase(
        "nothing",
        shared=tuple(_drawn(rng, name) for name in names),
        terms=TERMS,
        design=_design(*names),
        noise=NOISE_FACTORS[index // 2 % 4],
    )


def _other(index: int, rng: np.random.Generator) -> PairCase:
    effect = _drawn(rng, _turn(index, "other"))
    return PairCase(
        "other",
        (effect,),
        terms=("distance", "pixel") if index % 2 else (),
        design=_design(effect[0]),
        other_poses=True,
        noise=1.0 if index % 2 else 0.0,
    )


def _other_nothing(index: int, rng: np.random.Generator) -> PairCase:
    del index, rng
    return PairCase("other_nothing", terms=TERMS, design=_design(), other_poses=True, noise=1.0)


def _noise(index: int, rng: np.random.Generator) -> PairCase:
    """Noise and dropouts right, wrong or missing in a simulator that shares all else."""
    share = float(np.exp(rng.uniform(*np.log(DROPOUT_SHARES))))
    right = index % 4 == 0
    return PairCase(
        "noise",
        terms=TERMS,
        design=_design(),
        noise=NOISE_FACTORS[index % 4],
        dropouts=(share, share if right else 0.0),
        dark_dropouts=bool(index // 4 % 2),
        amplitude_gain=1.0 if right else float(rng.uniform(0.8, 1.25)),
    )


def _renderer(index: int, rng: np.random.Generator) -> PairCase:
    del rng
    name = _turn(index, "renderer")
    return PairCase("renderer", ((name, FIXED_MM),), design=_design(name), renderer="pybullet")


KINDS: dict[str, Callable[[int, np.random.Generator], PairCase]] = {
    "ideal": _ideal,
    "no_effect": _no_effect,
    "hand_eye": _hand_eye,
    "terms": _terms,
    "shared": _shared,
    "nothing": _nothing,
    "other": _other,
    "other_nothing": _other_nothing,
    "noise": _noise,
    "renderer": _renderer,
}
