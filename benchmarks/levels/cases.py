"""Small recordings of the renewed generator, with what is true of them."""

from collections.abc import Iterator
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

KINDS = ("nothing", "effect", "outside")
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
        form: The effect in it, or None.
        fields: The error of each effect (N, H, W), metres.
        expected: Radial distance without noise (N, H, W), metres.
        noise: Standard deviation of the noise (N, H, W), metres.
        size_mm: RMS of the effect over the pixels on the target.
    """

    about: dict[str, Any]
    form: Form | None
    fields: dict[str, Array]
    expected: Array
    noise: Array
    size_mm: float


def write_case(seed: int, kind: str, number: int, folder: Path) -> Case:
    """Write one recording; it depends on seed, kind and number alone."""
    form = _form_of(seed, kind, number)
    key = [1, number] if form is None else [0, number, sum(map(ord, form.effect + form.name))]
    rng = np.random.default_rng([seed, *key])
    with _small(kind):
        world = draw_world(rng, form.wanted if form else None)
        hooks = []
        if form is not None:
            sizes = OUTSIDE_MM if kind == "outside" else ranges.SIZES_MM
            size = sizes.draw(rng) * 1e-3
            hooks = [scaled(world, form, form.draw(rng, world), size)]
        recorded, truth = record(rng, world, hooks)
    write_recording(folder, recorded)
    sizes_mm = truth.sizes_mm(recorded.mask & np.isfinite(recorded.depth))
    return Case(
        about=described({"nothing": "N", "effect": "E", "outside": "O"}[kind], form, world)
        | {"poses": _poses(world)},
        form=form,
        fields=dict(truth.fields),
        expected=truth.expected,
        noise=noise_of(world, hooks),
        size_mm=max(sizes_mm.values(), default=0.0),
    )


def _poses(world: World) -> int:
    return int(world.way.pose_id[-1]) + 1


def _form_of(seed: int, kind: str, number: int) -> Form | None:
    """The form whose turn it is: every one once in each round, in an order of the round's own."""
    if kind == "nothing":
        return None
    forms = FORMS[kind]
    order = np.random.default_rng([seed, number // len(forms)]).permutation(len(forms))
    return forms[order[number % len(forms)]]


@contextmanager
def _small(kind: str) -> Iterator[None]:
    """Draw small images and few frames; everything else is as in the renewed check."""
    frames = FRAMES["nothing" if kind == "nothing" else "effect"]
    with patch.multiple(ranges, IMAGES=IMAGES, FRAMES=frames):
        yield
