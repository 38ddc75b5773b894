"""The third party's light against what follows by hand."""

import importlib.util
import os

import numpy as np
import pytest

from benchmarks.renewed.rendering import Renderer, Room, delay_at, start_renderer

needs_renderer = pytest.mark.skipif(
    importlib.util.find_spec("mitransient") is None or not os.environ.get("DRJIT_LIBLLVM_PATH"),
    reason="needs the extra `renewed`, and LLVM 16 or newer named by $DRJIT_LIBLLVM_PATH",
)


@needs_renderer
@pytest.mark.slow
def test_a_wall_alone_has_no_indirect_light() -> None:
    light = Renderer(Room()).at(_camera(1.0), np.array([[0.0, 0.1, 0.0]]), 256, 0)
    assert np.abs(light).max() == 0


@needs_renderer
@pytest.mark.slow
def test_one_bounce_on_the_floor_has_the_size_of_the_integral_over_it() -> None:
    # Light at the floor, from there to the target: an integral over the floor, by a fine grid.
    height, distance, albedo = 0.5, 1.2, 0.001
    point = np.array([0.0, -0.1, 0.0])
    # Both so dark that second bounces do not count.
    room = Room(floor=-height, albedo=albedo, target_albedo=0.001)
    light = Renderer(room).at(_camera(distance), point[None], 1 << 16, 0)
    x, z = np.meshgrid(np.linspace(-5, 5, 1001), np.linspace(0.005, 6, 1200))
    floor = np.stack([x, np.full_like(x, -height), z], -1)
    lamp, back = floor - np.array([0, 0, distance]), floor - point
    near, far = np.linalg.norm(back, axis=-1), np.linalg.norm(lamp, axis=-1)
    spot = np.degrees(np.arccos(-lamp[..., 2] / far))
    beam = np.clip((50 - spot) / 12, 0, 1)
    there = np.abs(lamp[..., 1]) / far**3 * beam
    on = np.abs(back[..., 1]) / near * (z / near) / near**2
    indirect = (albedo / np.pi * there * on).sum() * 0.01 * (6 - 0.005) / 1199
    length = np.hypot(distance, 0.1)
    direct = distance / length / length**2
    assert light.sum() == pytest.approx(indirect / direct, rel=0.05)


@needs_renderer
@pytest.mark.slow
@pytest.mark.parametrize("cosine", [0.5, 0.9])
def test_light_of_a_slab_is_as_late_whatever_the_random_paths(cosine: float) -> None:
    # All samples of a ray once followed one path: delays differed by factors from seed to seed.
    start_renderer()
    one, other = (delay_at(0.9, 0.0, cosine, seed) for seed in (0, 1))
    assert one == pytest.approx(other, rel=0.05)  # 65 536 paths: about one per cent


def _camera(distance: float) -> np.ndarray:
    camera = np.diag([1.0, -1.0, -1.0, 1.0])
    camera[2, 3] = distance
    return camera
