"""What a simulator says of its own error, hand-eye transform and parameters counts."""

from dataclasses import replace
from pathlib import Path

import diagnosed_recordings
import pytest
import torch

from tofcorr.data.recording import Recording
from tofcorr.diagnosis.diagnose import diagnose
from tofcorr.diagnosis.given import GivenSimulator, frames_of, rendered_error
from tofcorr.diagnosis.options import DiagnosisOptions
from tofcorr.diagnosis.prepare import prepare
from tofcorr.diagnosis.sums.observations import Observations, observe, predicted_distance
from tofcorr.simulation.options import SimulatorOptions

# One candidate effect is enough for laws about the simulator.
OPTIONS = DiagnosisOptions(
    bootstraps=40, simulate_anew=False, page=False, catalogue=("integration_time",)
)
# Rounding of depth to float32 at two metres.
ROUNDING = 3e-7


@pytest.fixture(scope="module")
def options() -> SimulatorOptions:
    """The camera of `nothing_missing`, its effects and errors included."""
    return diagnosed_recordings.options(31)


@pytest.fixture(scope="module")
def observations(nothing_missing: Recording) -> Observations:
    return observe(nothing_missing, OPTIONS.most_pixels)


def test_a_fixed_hand_eye_transform_is_that_of_the_simulator(
    nothing_missing: Recording, options: SimulatorOptions
) -> None:
    # It was the recording's guess, which the simulator does not share.
    fixed = OPTIONS.model_copy(update={"hand_eye": "fixed"})
    prepared = prepare(nothing_missing, fixed, GivenSimulator(options))
    assert torch.equal(prepared.study.fit.tool_from_camera, options.hand_eye.tool_from_camera())
    assert float(prepared.study.fit.residual.abs().median()) < 5e-3


def test_the_gap_as_given_is_that_of_the_simulators_own_parameters(
    nothing_missing: Recording, options: SimulatorOptions, observations: Observations
) -> None:
    """An ideal simulator with the true hand-eye transform: all errors of the camera are the gap."""
    without = options.sensor.model_copy(update={"delays": type(options.sensor.delays)()})
    ideal = options.model_copy(update={"sensor": without})
    found = diagnose(nothing_missing, ideal, OPTIONS)
    error = GivenSimulator(options).simulate(observations, OPTIONS).error
    truth = float(error.square().mean().sqrt())
    assert truth > 0.01
    assert found.gap.as_given is not None
    assert found.gap.as_given == pytest.approx(truth, rel=0.05)
    assert found.gap.before < 0.1 * truth
    assert (
        f"{found.gap.as_given * 1e3:.1f} mm"
        in found.verdict.split(".", 2)[0] + "." + (found.verdict.split(".", 2)[1])
    )
    shares = {share.cause: share.share for share in found.shares}
    assert sum(shares.values()) == pytest.approx(1.0, abs=1e-9)
    assert abs(shares["hand_eye"]) < 0.05


def test_what_a_simulator_does_elsewhere_is_carried_to_the_recording(
    nothing_missing: Recording,
    options: SimulatorOptions,
    observations: Observations,
    tmp_path: Path,
) -> None:
    """The simulator saw 50 other poses; its error at the recording's own is known from options."""
    elsewhere = diagnosed_recordings.recorded(tmp_path / "sim", 931, noise=False)
    exact = options.hand_eye.tool_from_camera().numpy()
    simulated = rendered_error(replace(elsewhere, tool_from_camera=exact), observations, OPTIONS)
    truth = GivenSimulator(options).simulate(observations, OPTIONS).error
    known = simulated.error.isfinite()
    assert float(known.double().mean()) > 0.9
    off = (simulated.error - truth)[known]
    assert float(off.square().mean().sqrt()) < 3e-4
    assert "other poses" in simulated.limits[0]
    assert simulated.carried


def test_the_truth_of_rendered_frames_is_their_own_plane(observations: Observations) -> None:
    """An error is simulated less true distance, whatever the hand-eye transform."""
    pose = torch.from_numpy(observations.recording.tool_from_camera)
    camera = observations.recording.camera
    size = camera.height * camera.width
    truth = torch.zeros(observations.num_frames, size, dtype=torch.float64)
    truth[observations.frame, observations.pixel] = predicted_distance(observations, pose)
    depth = (truth + 0.004).reshape(-1, camera.height, camera.width).numpy()
    error = rendered_error(frames_of(depth, observations.recording), observations, OPTIONS).error
    assert torch.allclose(error, torch.full_like(error, 0.004), atol=ROUNDING)
