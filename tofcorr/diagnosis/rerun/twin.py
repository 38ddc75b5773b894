"""The simulator run at the recording's own poses, seen through the chosen pixels."""

import torch
from torch import Tensor

from tofcorr.diagnosis.sums.observations import Observations
from tofcorr.simulation.options import SimulatorOptions
from tofcorr.simulation.twin import twin_frames

# Of larger recordings only some frames are simulated, evenly spread.
_MOST_PIXELS = 6_000_000


def simulated_frames(observations: Observations) -> list[int]:
    """Return the frames that are worth simulating: all, or so many as stay quick."""
    frames = observations.num_frames
    size = observations.recording.camera.height * observations.recording.camera.width
    most = max(8, _MOST_PIXELS // size)
    if frames <= most:
        return list(range(frames))
    return torch.linspace(0, frames - 1, most).round().long().unique().tolist()


def twin_distance(
    observations: Observations,
    simulator: SimulatorOptions,
    tool_from_camera: Tensor,
    generator: torch.Generator | None = None,
    frames: list[int] | None = None,
) -> Tensor:
    """Return what the simulated camera measures in the chosen pixels, shape (M,), metres.

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
