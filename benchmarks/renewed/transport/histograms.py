# pyright: reportMissingImports=false
"""Transient histograms of the light that reaches a point of the target indirectly.

mitransient's path integrator follows the light; here its contributions are sorted by the length of
their path. Those as long as there and back are the direct light, which the signal chain has
without noise from its geometry: they are kept as one sum, and the rest as a histogram over it.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.renewed.transport.rooms import Room, scene_of
from benchmarks.renewed.transport.tracing import Light, Scene, start_renderer, traced

BIN = 0.02  # metres of path; at 100 MHz 2.4 degrees of phase of a term of a tenth: 0.1 mm at most
BINS = 1200  # paths up to 24 m
DIRECT_WITHIN = 1e-3  # metres of path by which direct light may differ, in single precision


@dataclass(frozen=True)
class Transient:
    """Light at some points of the target: indirect over direct, by additional path."""

    histogram: np.ndarray  # (K, BINS) share of the direct light
    noise: np.ndarray  # (K,) Monte Carlo standard error of the share of all bins together

    def phasor(self, frequency: float) -> np.ndarray:
        """Sum over the histogram (K,), relative to the direct light, at a modulation frequency."""
        extra = (np.arange(BINS) + 0.5) * BIN
        turn = np.exp(2j * np.pi * frequency / 299_792_458.0 * extra)
        return self.histogram @ turn


class Renderer:
    """One room, seen from one camera after another."""

    def __init__(self, room: Room) -> None:
        import mitsuba as mi

        start_renderer()
        self._scene: Scene = mi.load_dict(scene_of(room, np.eye(4)))
        self._parameters: Any = mi.traverse(self._scene)

    def at(self, camera: np.ndarray, points: np.ndarray, samples: int, seed: int) -> Transient:
        """Render the light at points (K, 3) of the target with light and eye at a camera (4, 4)."""
        import drjit as dr
        import mitsuba as mi

        # Opaque numbers: as literals they would be compiled into a kernel of each camera's own.
        here = mi.Transform4f(camera.tolist())
        dr.make_opaque(here)
        self._parameters["light.to_world"] = here
        self._parameters.update()
        start = mi.Point3f(*map(float, camera[:3, 3]))
        dr.make_opaque(start)
        origin, count = camera[:3, 3], len(points)
        toward = points - origin
        length = np.linalg.norm(toward, axis=-1)
        index = dr.arange(mi.UInt32, count * samples) // samples
        rays = mi.Ray3f(
            start,
            dr.gather(mi.Vector3f, mi.Vector3f((toward / length[:, None]).T), index),
        )
        there_and_back = dr.gather(mi.Float, mi.Float(2 * length), index)
        direct = dr.zeros(mi.Float, count)
        bins = dr.zeros(mi.Float, count * BINS)
        squares = dr.zeros(mi.Float, count)

        def add(spec: Light, distance: Light, _wavelengths: object, active: Light) -> None:
            extra = distance - there_and_back
            light = spec.x / samples
            first = active & (extra < DIRECT_WITHIN)
            later = active & ~first & (extra < BIN * BINS)
            dr.scatter_reduce(dr.ReduceOp.Add, direct, light, index, first)
            where = index * BINS + mi.UInt32(dr.select(later, extra / BIN, 0.0))
            dr.scatter_reduce(dr.ReduceOp.Add, bins, light, where, later)
            dr.scatter_reduce(dr.ReduceOp.Add, squares, dr.square(light), index, later)

        radiance = traced(self._scene, rays, seed, add)
        dr.eval(radiance, direct, bins, squares)
        base = np.array(direct)
        if not (base > 0).all():
            raise RuntimeError("the renderer returned no direct light at some points of the target")
        return Transient(
            np.array(bins).reshape(count, BINS) / base[:, None], np.sqrt(np.array(squares)) / base
        )
