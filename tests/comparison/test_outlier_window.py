"""Pixels far from every plane are left out of a comparison, as if they were masked."""

from pathlib import Path

import numpy as np
import pytest
import torch
from comparison.evaluated import MODELS, compared, options
from synthetic_scene import Scene, write_scene

from tofcorr.errors import CalibrationDataError
from tofcorr.pixels.dataset import Dataset
from tofcorr.pixels.sample import MaskOptions, usable_pixels


def with_outliers(scene: Scene, *, masked: bool) -> dict[str, np.ndarray]:
    depth = scene.batch.radial_distance.float().numpy().copy()
    mask = np.ones_like(depth, dtype=np.uint8)
    depth[3, 2, 4:9] += 0.5
    depth[17, 5, 1:4] -= 0.4
    if masked:
        mask[3, 2, 4:9] = mask[17, 5, 1:4] = 0
    return {"depth": depth, "mask": mask}


def test_pixels_outside_the_window_count_as_masked_out(scene: Scene, tmp_path: Path) -> None:
    guess = scene.truth.tool_from_camera
    spoilt = write_scene(scene, tmp_path / "a", guess, **with_outliers(scene, masked=False))
    masked = write_scene(scene, tmp_path / "b", guess, **with_outliers(scene, masked=True))
    asked = options(models=MODELS[1:2], folds=2)
    window = asked.model_copy(update={"outlier_window_mm": 200.0})
    found = compared("a", Dataset((spoilt,)), window)
    expected = compared("b", Dataset((masked,)), window)
    unguarded = compared("c", Dataset((spoilt,)), asked)
    assert found.fitter.num_pixels == expected.fitter.num_pixels
    for column in asked.columns:
        values = found.values["folds"]["rms_mm"][column]
        # The domain that scales the variables has seen the outliers, the optimum has not.
        np.testing.assert_allclose(values, expected.values["folds"]["rms_mm"][column], rtol=1e-5)
    mean = found.estimate("folds", "rms_mm", "EA").mean
    assert unguarded.estimate("folds", "rms_mm", "EA").mean > 2 * mean


def test_the_window_lies_about_the_median_raw_error(scene: Scene, tmp_path: Path) -> None:
    far = scene.batch.radial_distance.float().numpy() + np.float32(0.3)
    known = scene.truth.tool_from_camera
    dataset = Dataset((write_scene(scene, tmp_path / "a", known, depth=far),))
    inside = usable_pixels(dataset, MaskOptions(outlier_window_mm=150.0), robust=False)
    assert sum(int(one.valid.sum()) for one in inside.batches()) == int(scene.batch.valid.sum())
    assert usable_pixels(dataset, MaskOptions(), robust=False) is dataset


def test_a_window_without_any_plane_in_sight_is_refused(scene: Scene, tmp_path: Path) -> None:
    about_face = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0])).double()
    guess = scene.truth.tool_from_camera @ about_face
    dataset = Dataset((write_scene(scene, tmp_path / "a", guess),))
    with pytest.raises(CalibrationDataError, match="outlier_window_mm needs pixels"):
        usable_pixels(dataset, MaskOptions(outlier_window_mm=80.0), robust=False)
