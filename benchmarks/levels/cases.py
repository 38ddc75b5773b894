"""Small recordings of the renewed generator, with what is true of them."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

from benchmarks.renewed.cases import described
from benchmarks.renewed.forms import INSIDE, OUTSIDE
from benchmarks.renewed.generator import ranges
from benchmarks.renewed.generator.form import Form
from benchmarks.renewed.generator.measure import noise_of
from benchmarks.renewed.generator.recording import record
from benchmarks.renewed.generator.strength import scaled
from benchmarks.renewed.generator.world import World, draw_world
from benchmarks.renewed.generator.writing import write_recording
from benchmarks.withheld.generator.rigid import Array

KINDS = ("nothing", "effect", "outside", "pair")
TIERS = {"nothing": "N", "effect": "E", "outside": "O", "pair": "P"}
IMAGES = {(32, 24): 0.6, (48, 36): 0.4}
FRAMES = {
    "nothing": {15: 0.06, 20: 0.06, 30: 0.22, 45: 0.3, 60: 0.36},
    "effect": {15: 0.06, 20: 0.06, 30: 0.14, 45: 0.3, 60: 0.44},
}
OUTSIDE_MM = ranges.Range(3.0, 6.0)
FORMS: dict[str, tuple[Form, ...]] = {
    # What is rendered would take longer than its diagnosis.
    "effect": tuple(
        form for form in INSIDE if form.effect != "multipath" and "slab" not in form.name
    ),
    "outside": OUTSIDE,
}


@dataclass(frozen=True)
class Case:
    """One recording, written to a folder, and its truth.

    Attributes:
        about: What was drawn.
        forms: The effects in it.
        fields: The error of each effect (N, H, W), metres.
        expected: Radial distance without noise (N, H, W), metres.
        noise: Standard deviation of the noise (N, H, W), metres.
        sizes_mm: RMS of each effect over the pixels on the target.
    """

    about: dict[str, Any]
    forms: tuple[Form, ...]
    fields: dict[str, Array]
    expected: Array
    noise: Array
    sizes_mm: dict[str, float]

    @property
    def size_mm(self) -> float:
        """RMS of the largest effect; 0 without one."""
        return max(self.sizes_mm.values(), default=0.0)


def write_case(seed: int, kind: str, number: int, folder: Path) -> Case:
    """Write one recording; it depends on seed, kind and number alone."""
    forms = _forms_of(seed, kind, number)
    key = [0, number, sum(sum(map(ord, form.effect + form.name)) for form in forms)]
    rng = np.random.default_rng([seed, *(key if forms else [1, number])])
    with small_images(kind):
        world = draw_world(rng, wanted_by(forms))
        hooks = []
        for form in forms:
            sizes = OUTSIDE_MM if kind == "outside" else ranges.SIZES_MM
            size = sizes.draw(rng) * 1e-3
            hooks.append(scaled(world, form, form.draw(rng, world), size))
        recorded, truth = record(rng, world, hooks)
    write_recording(folder, recorded)
    return Case(
        about=described(TIERS[kind], forms[0] if len(forms) == 1 else None, world)
        | {"poses": _poses(world)},
        forms=forms,
        fields=dict(truth.fields),
        expected=truth.expected,
        noise=noise_of(world, hooks),
        sizes_mm=truth.sizes_mm(recorded.mask & np.isfinite(recorded.depth)),
    )


def _poses(world: World) -> int:
    return int(world.way.pose_id[-1]) + 1


def _forms_of(seed: int, kind: str, number: int) -> tuple[Form, ...]:
    """The forms of a recording.

    Of one effect it is the form whose turn it is: every one once in each round, in an order of the
    round's own. Two effects are drawn until one design can show both.
    """
    if kind == "nothing":
        return ()
    if kind == "pair":
        forms = FORMS["effect"]
        rng = np.random.default_rng([seed, 2, number])
        while True:
            one, other = (forms[i] for i in rng.choice(len(forms), 2, replace=False))
            if one.effect != other.effect and _agree(one, other):
                return one, other
    forms = FORMS[kind]
    order = np.random.default_rng([seed, number // len(forms)]).permutation(len(forms))
    return (forms[order[number % len(forms)]],)


def _agree(one: Form, other: Form) -> bool:
    """Whether one design is like both forms want it."""
    shared = (one.wanted.keys() & other.wanted.keys()) - {"logged"}
    return all(one.wanted[key] == other.wanted[key] for key in shared)


def wanted_by(forms: Sequence[Form]) -> dict[str, Any]:
    """What the design must be like for all forms."""
    wanted = {key: value for form in forms for key, value in form.wanted.items()}
    logged = tuple(name for form in forms for name in form.wanted.get("logged", ()))
    return wanted | ({"logged": logged} if logged else {})


@contextmanager
def small_images(kind: str) -> Iterator[None]:
    """Draw small images and few frames; everything else is as in the renewed check."""
    frames = FRAMES["nothing" if kind == "nothing" else "effect"]
    with patch.multiple(ranges, IMAGES=IMAGES, FRAMES=frames):
        yield
