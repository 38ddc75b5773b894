"""Only recordings of one camera in one setting are calibrated together."""

from pathlib import Path
from typing import Any

import pytest
import torch
from kinds_of_terms import DOMAIN
from small_recordings import CAMERA, write_small_recording
from synthetic_scene import EA

from tofcorr.data.recording import Recording
from tofcorr.error_terms.model import ErrorModel, ErrorModelOptions
from tofcorr.errors import CalibrationDataError
from tofcorr.estimation.accumulator import Design, MomentAccumulator
from tofcorr.geometry.camera import FrameNames
from tofcorr.geometry.rays import ray_directions
from tofcorr.pixels.dataset import Dataset
from tofcorr.pixels.passes import image_moments


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"modulation_frequency": 30e6}, "its modulation_frequency is 30000000.0, that of .*one"),
        ({"depth_kind": "z"}, "its depth_kind is z, that of .*one is radial"),
        ({"frame_names": FrameNames(eye_to_hand=True)}, "eye_to_hand is True, that of .*one"),
    ],
)
def test_a_recording_of_another_setting_is_refused_with_both_values(
    change: dict[str, Any], message: str, tmp_path: Path
) -> None:
    one = Recording.open(write_small_recording(tmp_path / "one"))
    other = Recording.open(write_small_recording(tmp_path / "other", **change))
    assert Dataset((one, one)).num_frames == 2 * one.num_frames
    with pytest.raises(CalibrationDataError, match="There is no recording to calibrate"):
        Dataset(())
    with pytest.raises(CalibrationDataError, match=message):
        Dataset((one, other))


@pytest.mark.parametrize("few", [0.0, 1.0], ids=["in blocks", "pixel by pixel"])
@pytest.mark.parametrize("depth_kind", ["radial", "z"])
def test_moments_of_images_as_recorded_are_those_of_images_in_float64(
    depth_kind: Any, few: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(MomentAccumulator, "few_pixels", few)
    path = write_small_recording(tmp_path / "one", depth_kind=depth_kind)
    dataset = Dataset((Recording.open(path),))
    model = ErrorModel(ErrorModelOptions.from_mapping(EA, "EA"), DOMAIN)
    design = Design(model, DOMAIN, ray_directions(CAMERA))
    found = image_moments(dataset, design)
    (batch,) = dataset.batches()
    assert batch.radial_distance.dtype == torch.float64
    expected = MomentAccumulator(design)(batch)
    assert torch.equal(found.gram, expected.gram)
    assert torch.equal(found.normal_tool, expected.normal_tool)
    assert torch.equal(found.count, batch.valid.sum(dim=(1, 2)).double())
