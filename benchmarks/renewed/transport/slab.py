# pyright: reportMissingImports=false
"""How much later light returns from a scattering slab than from its surface, over the angle.

A homogeneous medium without a boundary that refracts, lit and seen from one point: mitransient's
volumetric path integrator. Lengths scale with the mean free path, so one table serves all.
"""

from typing import Any

import numpy as np

from benchmarks.renewed.transport.cache import cached
from benchmarks.renewed.transport.tracing import Light, start_renderer, traced

COSINES = np.linspace(0.3, 1.0, 15)
DISTANCE = 2000.0  # of camera and light, mean free paths
SPOT = np.array([37.0, 11.0, 0.0])  # where the ray meets the slab: on no edge of its triangles
THICK = 60.0  # mean free paths
SAMPLES = 1 << 16  # paths an angle
LANES = 64  # sums side by side
COMPLETE_WITHIN = 0.01  # of the radiance must be in the sums


def delays(albedo: float, forward: float) -> np.ndarray:
    """Mean extra distance (15,) at `COSINES`, in mean free paths.

    Args:
        albedo: Of a single scattering.
        forward: Mean cosine of a scattering (Henyey-Greenstein).
    """
    return cached(f"slab 2 {albedo} {forward} {SAMPLES}", lambda: _rendered(albedo, forward))


def _rendered(albedo: float, forward: float) -> np.ndarray:
    start_renderer()
    return np.array([_delay(albedo, forward, float(c), i) for i, c in enumerate(COSINES)])


def _delay(albedo: float, forward: float, cosine: float, seed: int) -> float:
    import drjit as dr
    import mitsuba as mi

    toward = -np.array([np.sqrt(1 - cosine**2), 0.0, cosine])
    where = SPOT - DISTANCE * toward
    scene: Any = mi.load_dict(_slab(albedo, forward, where))
    lane = dr.arange(mi.UInt32, SAMPLES) % LANES
    start = mi.Point3f(*map(float, where)) + dr.zeros(mi.Float, SAMPLES)
    rays = mi.Ray3f(start, mi.Vector3f(*map(float, toward)))
    light, later = dr.zeros(mi.Float, LANES), dr.zeros(mi.Float, LANES)

    def add(spec: Light, distance: Light, _wavelengths: object, active: Light) -> None:
        extra = distance / 2 - DISTANCE
        dr.scatter_reduce(dr.ReduceOp.Add, light, spec.x, lane, active)
        dr.scatter_reduce(dr.ReduceOp.Add, later, spec.x * extra, lane, active)

    scene.integrator().prepare_scene(scene)
    radiance = traced(scene, rays, seed, add)
    dr.eval(radiance, light, later)
    total, everything = light.numpy().sum(), mi.luminance(radiance).numpy().sum()
    if not abs(total - everything) < COMPLETE_WITHIN * everything:
        raise RuntimeError(f"the renderer lost light: {total:.3g} of {everything:.3g} came")
    return float(later.numpy().sum() / total)


def _slab(albedo: float, forward: float, where: np.ndarray) -> dict[str, Any]:
    import mitsuba as mi

    wide = mi.ScalarTransform4f().translate([0, 0, -THICK / 2]).scale([5e4, 5e4, THICK / 2])
    return {
        "type": "scene",
        "integrator": {"type": "transient_prbvolpath", "max_depth": 200, "rr_depth": 60},
        "light": {
            "type": "point",
            "position": where.tolist(),
            "intensity": {"type": "rgb", "value": 1e6},
        },
        "slab": {
            "type": "cube",
            "to_world": wide,
            "bsdf": {"type": "null"},
            "interior": {
                "type": "homogeneous",
                "albedo": {"type": "rgb", "value": albedo},
                "sigma_t": 1.0,
                "phase": {"type": "hg", "g": forward},
            },
        },
    }
