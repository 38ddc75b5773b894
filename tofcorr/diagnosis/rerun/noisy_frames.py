"""Frames of the built-in simulator at a recording's poses, with noise, as a recording."""

from pathlib import Path

import numpy as np
import torch

from tofcorr.data.recording import Recording
from tofcorr.data.table import FrameRow
from tofcorr.data.writing import RecordingWriter
from tofcorr.diagnosis.rerun.twin import simulated_frames
from tofcorr.files.staged import scratch_folder
from tofcorr.geometry.ranges import z_depth_from_radial_distance
from tofcorr.geometry.rays import ray_directions
from tofcorr.observables import Observables, compare_observables
from tofcorr.simulation.options import SimulatorOptions
from tofcorr.simulation.twin import Reflectivity, twin_frames


def observables_of(
    recording: Recording, sim: Recording | SimulatorOptions | None, *, seed: int, level: float
) -> Observables:
    """Compare noise, missing pixels and amplitude of a recording with those of a simulator.

    Args:
        recording: The real recording.
        sim: Frames that any simulator rendered; or options of the built-in one, which is then run
            with noise at the recording's poses; None: the recording alone is measured.
        seed: Of noise, resamples and permutations.
        level: Significance level of what is reported.
    """
    if sim is None or isinstance(sim, Recording):
        return compare_observables(recording, sim, seed=seed, level=level)
    with scratch_folder() as folder:
        frames = noisy_frames(recording, sim, seed, folder / "frames")
        return compare_observables(recording, frames, seed=seed, level=level)


def noisy_frames(
    recording: Recording, simulator: SimulatorOptions, seed: int, folder: Path
) -> Recording:
    """Run the built-in simulator with noise at the poses of a recording, and write its frames.

    The targets are those of the simulator's scene. Where the scene lacks a target, reflectivities
    come from the recorded amplitudes instead.

    Args:
        recording: Poses, planes, targets, conditions and masks.
        simulator: What to run.
        seed: Of the noise.
        folder: The folder to write; it must not exist yet.
    """
    camera = recording.camera
    frames = simulated_frames(recording)
    named = set(recording.frames.target.tolist()) <= simulator.scene.targets.keys()
    source: Reflectivity = "from_recording"
    if named or recording.amplitude is None:
        source = "pattern"
    states = twin_frames(
        simulator,
        recording,
        torch.Generator().manual_seed(seed),
        reflectivity=source,
        indices=frames,
    )
    with RecordingWriter(
        folder,
        camera=camera,
        depth_kind=recording.depth_kind,
        modulation_frequency=recording.modulation_frequency,
        tool_from_camera=recording.tool_from_camera,
    ) as writer:
        for frame, state in zip(frames, states, strict=True):
            depth = state.measured_distance
            if recording.depth_kind == "z":
                depth = z_depth_from_radial_distance(depth, ray_directions(camera))
            mask = recording.read("mask", np.array([frame]))
            row: FrameRow = recording.frames.row(frame)
            writer.append(
                depth.numpy(),
                row=row,
                amplitude=state.measured_amplitude.nan_to_num(0.0).numpy(),
                mask=None if mask is None else mask[0],
            )
    return Recording.open(folder, check_contents=False)
