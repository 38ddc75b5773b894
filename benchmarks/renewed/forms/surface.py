"""Forms of light that enters the target, or returns from it by the angle."""

import numpy as np

from benchmarks.renewed.geometry import Random
from benchmarks.renewed.rendering import COSINES, delays
from benchmarks.renewed.signal_chain import Change, adding, form
from benchmarks.renewed.world import World

STEEP = float(np.deg2rad(36.0))
MATERIALS = ((0.98, 0.5), (0.9, 0.0))  # albedo and mean cosine of a scattering


@form("incidence_angle", "path", 0.05, textbook=True, tilt=STEEP)
def clear_layer(rng: Random, world: World) -> Change:
    """Varnish over a white ground: a refracted way down and up again."""
    index = rng.uniform(1.3, 1.6)
    return adding(lambda view: index / np.sqrt(1 - (1 - view.cosine**2) / index**2) - index)


@form("incidence_angle", "path", 0.003, tilt=STEEP)
def rendered_slab(rng: Random, world: World) -> Change:
    """Light walks in a scattering slab; the strength is its mean free path."""
    table = delays(*MATERIALS[rng.integers(len(MATERIALS))])
    return adding(lambda view: np.interp(view.cosine, COSINES, table))


@form("incidence_angle", "path", 0.1, tilt=STEEP)
def grazing(rng: Random, world: World) -> Change:
    """A rough face: only at flat angles do rays meet its peaks first."""
    start, sign = np.cos(np.deg2rad(rng.uniform(20.0, 35.0))), rng.choice([-1.0, 1.0])
    return adding(lambda view: sign * np.maximum(start - view.cosine, 0.0))
