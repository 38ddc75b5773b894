# pyright: reportMissingImports=false
"""Follow light through a scene of mitransient, and see each contribution that arrives."""

from collections.abc import Callable
from typing import Any

Light = Any  # an array of drjit
Scene = Any  # of mitsuba
Rays = Any  # of mitsuba
Add = Callable[[Light, Light, object, Light], None]  # light, path's length, wavelengths, active
VARIANT = "llvm_ad_rgb"


def start_renderer() -> None:
    """Choose the renderer's kind of numbers and register mitransient's integrators."""
    import mitsuba as mi

    if mi.variant() != VARIANT:
        mi.set_variant(VARIANT)
    import mitransient  # noqa: F401


def traced(scene: Scene, rays: Rays, seed: int, add: Add) -> Light:
    """Return the radiance of rays; `add` is called with every contribution.

    What `add` sums is a side effect of the radiance: evaluate both together.
    """
    import drjit as dr
    import mitsuba as mi

    sampler = mi.load_dict({"type": "independent"})
    # Of one ray from one place all paths would be the same.
    sampler.seed(seed, max(dr.width(rays.o), dr.width(rays.d)))
    return scene.integrator().sample(
        mode=dr.ADMode.Primal,
        scene=scene,
        sampler=sampler,
        ray=rays,
        depth=mi.UInt32(0),
        β=mi.Spectrum(1),
        δL=None,
        state_in=None,
        active=mi.Bool(True),
        add_transient=add,
    )[0]
