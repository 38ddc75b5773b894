"""The simulator run at the recording's own poses, sampled at the chosen pixels."""

import torch
from torch import Tensor

from tofcorr.data.recording import Recording
from tofcorr.diagnosis.findings.naming import NamedEffects
from tofcorr.diagnosis.rerun.fitted_simulator import (
    observed_by,
    simulator_of,
    solution_of,
    tables_of,
)
from tofcorr.diagnosis.sums.observations import Observations, predicted_distance
from tofcorr.diagnosis.sums.study import Study
from tofcorr.simulation.options import SimulatorOptions
from tofcorr.simulation.twin import twin_frames

# Pixels that are simulated at most, and frames at least: of larger recordings only some frames are
# simulated, evenly spread. Chosen to bound the time.
_MOST_PIXELS = 6_000_000
_LEAST_FRAMES = 8


def simulated_frames(recording: Recording) -> list[int]:
    """Return the frames to simulate: all, or as many as do not take long."""
    frames = recording.num_frames
    size = recording.camera.height * recording.camera.width
    most = max(_LEAST_FRAMES, _MOST_PIXELS // size)
    if frames <= most:
        return list(range(frames))
    return torch.linspace(0, frames - 1, most).round().long().unique().tolist()


def fitted_distance(
    study: Study,
    named: NamedEffects | None,
    given: SimulatorOptions | None,
    generator: torch.Generator | None = None,
    frames: list[int] | None = None,
) -> Tensor:
    """Return what the fitted simulator measures in the chosen pixels, shape (M,), metres.

    The error that frames of another simulator showed is added to its distances, and so are errors
    of base terms that it has no table for.

    Args:
        study: The recording.
        named: With these effects; None: base model alone.
        given: The simulator under diagnosis; None: one made from the recording alone.
        generator: Source of noise; None: the expected measurement.
        frames: Which frames; None: all.

    Returns:
        NaN in frames left out and where the simulated camera has no distance.
    """
    pose = solution_of(study, named)[0]
    simulator = simulator_of(study, named, given)
    observations = observed_by(study, named)
    distance = twin_distance(observations, simulator, pose, generator, frames)
    if given is None and study.fit.known is not None:
        distance = distance + study.fit.known.error
    tables = tables_of(study, named, given)
    if not tables.beyond:
        return distance
    predicted = predicted_distance(observations, pose)
    return distance + tables.error_beyond(study.fit.model, predicted)


def twin_distance(
    observations: Observations,
    simulator: SimulatorOptions,
    tool_from_camera: Tensor,
    generator: torch.Generator | None = None,
    frames: list[int] | None = None,
) -> Tensor:
    """Return what a simulated camera measures in the chosen pixels, shape (M,), metres.

    Args:
        observations: Poses, brightness and chosen pixels.
        simulator: What to run.
        tool_from_camera: Hand-eye transform, shape (4, 4).
        generator: Source of noise; None: the expected measurement.
        frames: Which frames; None: all.

    Returns:
        NaN in frames left out and where the simulated camera has no distance.
    """
    recording = observations.recording
    known = observations.amplitude is not None
    measured = torch.full_like(observations.measured, torch.nan)
    chosen = list(range(observations.num_frames)) if frames is None else frames
    ends = observations.frame_ends
    states = twin_frames(
        simulator,
        recording,
        generator,
        tool_from_camera=tool_from_camera,
        reflectivity="from_recording" if known else "pattern",
        indices=chosen,
    )
    for frame, state in zip(chosen, states, strict=True):
        start, end = ends[frame]
        pixels = observations.pixel[start:end]
        measured[start:end] = state.measured_distance.reshape(-1)[pixels]
    return measured
