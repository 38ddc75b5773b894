"""What a diagnosis named is corrected where that helps, and nothing else."""

import json
from collections.abc import Mapping
from pathlib import Path

import pytest
import torch
from simulated_walls import EA, QUIET, simulated_wall, true_hand_eye

import tofcorr
from tofcorr import CalibrationDataError
from tofcorr.data.recording import planes_in_tool
from tofcorr.geometry import se3
from tofcorr.pixels.dataset import Dataset

TIMES = {"integration_time_us": [400.0, 1000.0], "frame_interval_s": 20.0}
LATE = {"name": "timestamp_offset", "offset_s": 0.04}


def diagnosed(
    folder: Path, *names: str, values: Mapping[str, float] | None = None, **more: object
) -> Path:
    """Write what `train_with` reads of a diagnosis that named effects."""
    fitted = [{"cause": names[0], "name": name, "value": v} for name, v in (values or {}).items()]
    content = {"format": "tofcorr-diagnosis", "cause_sets": [[one] for one in names]}
    (folder / "diagnosis.json").write_text(json.dumps(content | {"fitted": fitted} | more))
    return folder


@pytest.fixture(scope="module")
def two_exposures(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """A camera that reads nearer the longer it exposes, and does nothing else that is named."""
    effects = [{"name": "integration_time", "reference_us": 1000.0, "log_1": 0.02}]
    folder = tmp_path_factory.mktemp("exposures") / "recording"
    return simulated_wall(folder, seed=31, effects=effects, conditions=TIMES)


def test_what_was_named_is_corrected_where_it_predicts_better_and_the_rest_is_left_out(
    two_exposures: Dataset, tmp_path: Path
) -> None:
    light = {"gain": 2e-3, "gain_interval": [1e-3, 3e-3], "light_half_angle_deg": 40.0}
    names = "integration_time", "wiggling", "lens", "mixed_pixels", "multipath"
    named = diagnosed(tmp_path, *names, second_bounces=light | {"frequencies_hz": [20e6]})
    plain = tofcorr.train(two_exposures.first, "ea")
    found = tofcorr.train_with(named, two_exposures.first, "ea")
    effects = {one["effect"]: one for one in found.report["named"]["effects"]}
    kept = [name for name, one in effects.items() if one["kept"]]
    assert kept == ["integration_time", "mixed_pixels", "multipath"]
    runtime = found.options.runtime
    assert runtime.flying_pixels is not None
    assert runtime.second_bounces is not None
    assert runtime.second_bounces.gain == 2e-3
    assert runtime.second_bounces.light_half_angle_deg == 40.0
    assert effects["integration_time"]["p_value"] < 0.05
    assert effects["wiggling"]["with_mm"] > effects["wiggling"]["without_mm"] - 0.1
    assert effects["lens"]["why"] == "no single frame tells it, so no corrector can undo it"
    kinds = [term.kind for term in found.options.model.terms]
    assert kinds == [*(term.kind for term in plain.options.model.terms), "integration_time"]
    errors = [one.report["error_mm"]["after"]["test"]["rms"] for one in (found, plain)]
    assert errors[0] < 0.8 * errors[1]
    assert "integration_time is corrected: held-out images are off by " in repr(found)


def test_an_exposure_that_was_not_recorded_and_a_finer_form_are_said_and_tried(
    tmp_path: Path,
) -> None:
    wall = simulated_wall(tmp_path / "recording", seed=32, conditions={"recorded": ()})
    named = diagnosed(tmp_path, "integration_time", "distance")
    found = tofcorr.train_with(named, wall.first, "ea")
    first, second = found.report["named"]["effects"]
    assert "integration_time_us" in first["why"]
    # The simulator's distance error is a line: a quintic predicts no better than a cubic.
    assert not second["kept"]
    assert second["without_mm"] == pytest.approx(second["with_mm"], rel=0.05)


def test_a_clock_that_is_off_moves_the_poses_to_where_the_images_were_taken(tmp_path: Path) -> None:
    robot = {"motion": "continuous", "repeatability_mm": 0.05, "repeatability_mrad": 0.05}
    wall = simulated_wall(
        tmp_path / "recording",
        seed=33,
        shots=(("white", 48),),
        robot=robot,
        effects=[LATE],
        conditions={"frame_interval_s": 0.5},
    )
    values = {"offset_s": 0.04, "half_of_drift_s": 0.0}
    named = diagnosed(tmp_path, "timestamp_offset", values=values)
    found = tofcorr.train_with(named, wall.first, "ea")
    assert found.report["named"]["effects"][0]["kept"]
    off = [
        se3.apart(one.fit.solution.parameters.tool_from_camera, true_hand_eye(wall))[0]
        for one in (found, tofcorr.train(wall.first, "ea"))
    ]
    assert off[0] < 0.5 * off[1]


def test_without_a_named_effect_it_is_a_training_and_another_file_is_refused_in_words(
    two_exposures: Dataset, tmp_path: Path
) -> None:
    found = tofcorr.train_with(diagnosed(tmp_path), two_exposures.first, "e0")
    assert "The diagnosis names no effect." in repr(found)
    plain = tofcorr.train(two_exposures.first, "e0").report["error_mm"]
    assert found.report["error_mm"] == plain
    with pytest.raises(CalibrationDataError, match="expected a folder that tofcorr diagnose wrote"):
        tofcorr.train_with(two_exposures.first.path / "recording.yaml", two_exposures.first)
    with pytest.raises(CalibrationDataError, match="there is no such file"):
        tofcorr.train_with(two_exposures.first.path, two_exposures.first)


def test_stray_light_is_taken_back_in_the_fit_and_in_the_corrector(tmp_path: Path) -> None:
    shares = {"share_0.05": 0.0, "share_0.12": 0.15, "share_0.3": 0.0, "veil": 0.1}
    wall = simulated_wall(
        tmp_path / "recording",
        seed=34,
        shots=(("checkerboard", 24),),
        effects=[{"name": "stray_light", **shares}],
        sensor=QUIET,
        robot={"tilt_deg": 45.0, "steepest_incidence_deg": 80.0},
    )
    named, run = diagnosed(tmp_path, "stray_light", values=shares), tmp_path / "run"
    config = {"name": "EA", "model": EA, "figures": False, "outlier_window_mm": 1000.0}
    found = tofcorr.train_with(named, wall.first, config, out=run)
    plain = tofcorr.train(wall.first, config)
    assert found.report["named"]["effects"][0]["kept"]
    off = [
        se3.apart(one.fit.solution.parameters.tool_from_camera, true_hand_eye(wall))[0]
        for one in (found, plain)
    ]
    assert off[0] < 0.5 * off[1]
    # What was taken back in the fit is taken back at run time: points lie as near the walls.
    chosen = found.calibration.test
    images = [torch.from_numpy(wall.first.read(name, chosen)) for name in ("depth", "amplitude")]
    corrector = found.corrector()
    loaded = tofcorr.load_corrector(run / "corrector.ts", trust=True)
    torch.testing.assert_close(loaded(*images), corrector(*images), equal_nan=True)
    normal, offset = (one[chosen] for one in planes_in_tool(wall.first))
    points = corrector.points_tool(*images).double()
    apart = (points @ normal[:, None, :, None])[..., 0] + offset[:, None, None]
    expected = found.report["error_mm"]["after"]["test"]["mean_abs"]
    usable = next(found.data.batches(chosen)).valid
    assert 1e3 * float(apart[usable].abs().mean()) == pytest.approx(expected, rel=0.01)
