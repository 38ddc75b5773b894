"""Forms of light that enters the target, or returns from it by the angle."""

import numpy as np

from benchmarks.renewed.generator.form import Change, Form
from benchmarks.renewed.generator.view import View
from benchmarks.renewed.generator.world import World
from benchmarks.renewed.transport.slab import COSINES, delays
from benchmarks.withheld.generator.rigid import Array

TILTED = {"tilt": float(np.deg2rad(36.0))}
MATERIALS = ((0.98, 0.5), (0.9, 0.0))  # albedo and mean cosine of a scattering


def clear_layer(rng: np.random.Generator, world: World) -> Change:
    """Varnish over a white ground: a refracted way down and up again."""
    index = rng.uniform(1.3, 1.6)

    def change(strength: float, view: View, path: Array) -> Array:
        return path + strength * (index / np.sqrt(1 - (1 - view.cosine**2) / index**2) - index)

    return change


def rendered_slab(rng: np.random.Generator, world: World) -> Change:
    """Light walks in a scattering slab; the strength is its mean free path."""
    table = delays(*MATERIALS[rng.integers(len(MATERIALS))])

    def change(strength: float, view: View, path: Array) -> Array:
        return path + strength * np.interp(view.cosine, COSINES, table)

    return change


def grazing(rng: np.random.Generator, world: World) -> Change:
    """A rough face: only at flat angles do rays meet its peaks first."""
    start, sign = np.cos(np.deg2rad(rng.uniform(20.0, 35.0))), rng.choice([-1.0, 1.0])

    def change(strength: float, view: View, path: Array) -> Array:
        return path + sign * strength * np.maximum(start - view.cosine, 0.0)

    return change


FORMS = (
    Form("incidence_angle", "clear_layer", "path", True, clear_layer, 0.05, wanted=TILTED),
    Form("incidence_angle", "rendered_slab", "path", False, rendered_slab, 0.003, wanted=TILTED),
    Form("incidence_angle", "grazing", "path", False, grazing, 0.1, wanted=TILTED),
)
