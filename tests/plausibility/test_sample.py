"""The noise of a pixel is not what a plane looks like to wide pixels."""

from pathlib import Path
from typing import Literal

import numpy as np
import pytest
from small_recordings import frame_rows, small_images, write_small_recording

from tofcorr.data.recording import Recording
from tofcorr.geometry.rays import ray_directions
from tofcorr.pixels.dataset import Dataset
from tofcorr.plausibility.look import Look


@pytest.mark.parametrize("depth_kind", ["radial", "z"])
@pytest.mark.parametrize("noise", [0.0, 2e-3])
def test_noise_of_a_few_wide_pixels_is_that_of_their_depth(
    depth_kind: Literal["radial", "z"], noise: float, tmp_path: Path
) -> None:
    """Of 8 by 8 pixels 6 degrees wide, a tilted plane counted as noise: 12 mm instead of 3."""
    generator = np.random.default_rng(8)
    number = 60
    images = small_images(generator, number)
    rays = ray_directions(Recording.open(write_small_recording(tmp_path / "any")).camera).numpy()
    normal = np.stack([*generator.uniform(-0.5, 0.5, (2, number)), np.full(number, -1.0)], 1)
    radial = 2.0 / -np.einsum("hwc,nc->nhw", rays, normal)
    radial += noise * generator.standard_normal(radial.shape)
    depth = radial * rays[..., 2] if depth_kind == "z" else radial
    images |= {"depth": depth.astype(np.float32), "mask": None, "amplitude": None}
    rows = frame_rows(generator, number)
    folder = write_small_recording(tmp_path / "wide", rows=rows, depth_kind=depth_kind, **images)
    sample = Look(Dataset((Recording.open(folder),)))
    # 1500 differences give the noise to 4 %. The lens bends a row a little, which leaves 0.06 mm.
    assert sample.noise == pytest.approx(noise, rel=0.12, abs=1e-4)
