"""Outliers do not decide, and images that stand out are named."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from optional import present
from simulated_walls import fitted, simulated_wall, true_hand_eye
from synthetic_scene import frame_batch
from torch import Generator

from tofcorr.data.recording import FrameBatch
from tofcorr.estimation.robust import outlying_images, robust_scale, robust_weights
from tofcorr.geometry.rays import ray_plane_distance
from tofcorr.pixels.dataset import Dataset
from tofcorr.pixels.masks import edges, grazing, image_planes, off_the_wall


def contaminated(clean: Dataset, seed: int, share: float = 0.1) -> Dataset:
    """Return the frames with a share of their pixels that read anything between 0.1 and 3 m."""
    random, depth = np.random.default_rng(seed), np.array(clean.first.depth)
    bad = random.random(depth.shape) < share
    depth[bad] = random.uniform(0.1, 3.0, bad.sum())
    return Dataset((replace(clean.first, depth=depth),))


def hand_eye_error(dataset: Dataset, **options: Any) -> np.ndarray:
    """Return the error of translation (metres) and rotation (radians)."""
    best = fitted(dataset, **options).solution.parameters.tool_from_camera
    apart = best - true_hand_eye(dataset)
    return np.array([float(apart[:3, 3].norm()), float(apart[:3, :3].norm() / 2**0.5)])


@pytest.mark.parametrize("num_seeds", [2, pytest.param(6, marks=pytest.mark.slow)])
@pytest.mark.parametrize("loss", [pytest.param("huber", marks=pytest.mark.slow), "cauchy"])
def test_a_tenth_of_gross_outliers_leaves_the_hand_eye_within_half_again_its_clean_error(
    loss: str, num_seeds: int, tmp_path: Path
) -> None:
    robust = {"weights": {"noise": True, "robust": loss}}
    clean, dirty = [], []
    for seed in range(num_seeds):
        dataset = simulated_wall(tmp_path / f"{seed}", seed)
        clean.append(hand_eye_error(dataset, **robust))
        dirty.append(hand_eye_error(contaminated(dataset, seed), **robust))
    ratio = np.sqrt(np.mean(np.square(dirty), axis=0) / np.mean(np.square(clean), axis=0))
    assert ratio.max() < 1.5


@pytest.mark.slow
def test_noise_weights_make_the_hand_eye_better(tmp_path: Path) -> None:
    """At the least loss. Moved back by what the noise has moved it, it gains less by weights."""
    plain, weighted = [], []
    least = {"remove_noise_shift": False}
    for seed in range(6):
        dataset = simulated_wall(tmp_path / f"{seed}", seed)
        plain.append(hand_eye_error(dataset, **least)[0])
        weighted.append(hand_eye_error(dataset, weights={"noise": True}, **least)[0])
    assert np.square(weighted).mean() < 0.5 * np.square(plain).mean()


@pytest.mark.parametrize("loss", ["huber", "cauchy"])
def test_weights_are_the_slope_of_the_loss_over_the_residual(loss: Any) -> None:
    residual = torch.tensor([0.1, 1.0, 1.5, 4.0, 50.0], dtype=torch.float64, requires_grad=True)
    if loss == "huber":
        size = residual.abs()
        value = torch.where(size < 1.345, size**2 / 2, 1.345 * size - 1.345**2 / 2)
    else:
        value = 2.385**2 / 2 * torch.log1p((residual / 2.385) ** 2)
    (slope,) = torch.autograd.grad(value.sum(), residual)
    with torch.no_grad():
        torch.testing.assert_close(robust_weights(residual, loss) * residual, slope)


def test_the_robust_scale_of_normal_noise_is_its_standard_deviation(generator: Generator) -> None:
    residuals = 0.003 * torch.randn(100_000, generator=generator, dtype=torch.float64)
    assert robust_scale(residuals) == pytest.approx(0.003, rel=0.02)


def test_an_image_that_stands_out_is_named() -> None:
    random = np.random.default_rng(0)
    rms = 0.005 * np.exp(0.2 * random.normal(size=40))
    rms[17] = 0.05
    (found,) = outlying_images(np.arange(100, 140), rms)
    assert (found["frame"], found["rms_mm"]) == (117, pytest.approx(50.0))
    assert found["z"] > 3.5
    assert outlying_images(np.arange(5), np.full(5, 0.004)) == []


def planar_batch(normal: list[float], offset: float) -> tuple[FrameBatch, torch.Tensor]:
    across, down = torch.linspace(-0.5, 0.5, 24).double(), torch.linspace(-0.4, 0.4, 20).double()
    columns, rows = torch.meshgrid(across, down, indexing="xy")
    rays = torch.stack([columns, rows, torch.ones_like(rows)], dim=-1)
    rays = rays / rays.norm(dim=-1, keepdim=True)
    unit = torch.tensor([normal], dtype=torch.float64)
    unit = unit / unit.norm()
    plane = unit, torch.tensor([offset], dtype=torch.float64)
    distance = ray_plane_distance(rays, *plane)
    amplitude = torch.full_like(distance, 100.0)
    return frame_batch(distance, amplitude, *plane, distance.isfinite()), rays


def test_an_image_with_a_third_of_outliers_shows_its_plane() -> None:
    batch, rays = planar_batch([0.3, -0.2, -1.0], 1.1)
    batch.radial_distance[0, :, ::3] *= 0.6
    # One fitted to some pixels is that of all.
    for enough in (None, int(batch.valid.sum()) // 5):
        plane = image_planes(batch, rays, enough)
        torch.testing.assert_close(-plane, batch.normal_tool / batch.offset_tool, atol=1e-4, rtol=0)
    off = off_the_wall(batch, rays)[0]
    assert bool(off[:, ::3].all())
    assert not bool(off[:, 1::3].any())


def test_grazing_pixels_are_those_beyond_the_angle() -> None:
    batch, rays = planar_batch([1.2, 0.0, -1.0], 1.0)
    angle = torch.rad2deg(torch.arccos(-(rays @ batch.normal_tool[0])))
    found = grazing(batch, 55.0, rays)[0]
    assert torch.equal(found, angle > 55.0)
    assert 0 < int(found.sum()) < found.numel()


def test_edges_are_the_pixels_next_to_a_step_of_brightness() -> None:
    batch, _ = planar_batch([0.0, 0.0, -1.0], 1.0)
    present(batch.amplitude)[:, :, 12:] = 400.0
    found = edges(batch, 2.0)[0]
    assert bool(found[:, 11:13].all())
    assert not bool(found[:, :11].any())
    assert not bool(found[:, 13:].any())
