"""A sensor found at some poses closes the gap at others."""

import json
from pathlib import Path

import pytest
from diagnosed_recordings import PLAIN
from optional import present

from tofcorr.diagnosis.diagnose import diagnose
from tofcorr.diagnosis.report.result import DiagnosisResult
from tofcorr.sensor.model import SensorModel
from tofcorr.simulation.simulator import simulate

FAST = {"most_pixels": 40_000, "bootstraps": 19, "tests": {"flips": 99}}
WIGGLING = {"name": "wiggling", "sin_4": 0.012, "cos_4": 0.006}


def test_a_diagnosis_degrades_ideal_frames_of_poses_held_out(
    time_diagnosis: DiagnosisResult, page: str
) -> None:
    """Where every effect can be shown in an image, they are as near as the last stage."""
    found, gap = present(time_diagnosis.degraded), time_diagnosis.gap
    assert found.left_out == ()
    assert found.poses == time_diagnosis.evidence.study.observations.num_units
    # Same poses, pixels and floor; ten folds against single poses.
    assert found.gap**2 + gap.floor**2 == pytest.approx(gap.after**2 + gap.floor**2, rel=0.02)
    assert found.gap.interval[0] <= found.gap <= found.gap.interval[1]
    block = json.loads(json.dumps(time_diagnosis.to_mapping()["degraded"]))
    assert block["gap_mm"] == pytest.approx(1e3 * found.gap, abs=1e-3)
    assert "Ideal frames, degraded" in page


@pytest.mark.slow
def test_a_given_simulator_keeps_its_effects_and_errors_in_the_file(tmp_path: Path) -> None:
    """The file turns ideal depth into the camera's, whatever simulator was compared with it."""
    shots = [{"target": "white", "poses": 25}, {"target": "checkerboard", "poses": 25}]
    options = PLAIN | {"seed": 43, "shots": shots, "effects": [WIGGLING]}
    real = simulate(options, tmp_path / "real")
    quick = FAST | {"simulate_anew": False, "page": False}
    diagnose(real, options, quick, out=tmp_path / "given")
    diagnose(real, None, quick, out=tmp_path / "fitted")
    models = [SensorModel.load(tmp_path / name / "sensor.yaml") for name in ("given", "fitted")]
    assert [model.to_sensor_file().effects[0]["name"] for model in models] == ["wiggling"] * 2
    depth = 1.3 * models[0].eye.ray_directions[..., 2].reciprocal()
    amplitude = depth.new_full(depth.shape, 9000.0)
    given, fitted = (model(depth, amplitude, noise=False).depth.detach() for model in models)
    assert float((given - depth).mean()) > 0.01
    # Two fits of one recording: their errors agree within what its 50 poses determine.
    assert float((given - fitted).abs().mean()) < 2e-3
