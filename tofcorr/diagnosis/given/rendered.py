"""Frames that any simulator rendered: written as a recording, or returned by a Python function.

Each frame of the recording is compared with the renders that show what it shows.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any
from weakref import finalize

import numpy as np
import torch
from scipy.spatial.distance import cdist
from torch import Tensor

from tofcorr.conditions import CONDITIONS
from tofcorr.data.recording import Recording, planes_in_tool
from tofcorr.data.table import UNIT_LENGTH_TOLERANCE
from tofcorr.data.writing import write_recording
from tofcorr.diagnosis.given.checks import (
    refuse_mistaken_geometry,
    refuse_other_camera,
    refuse_without_truth,
)
from tofcorr.diagnosis.given.elsewhere import simulated_elsewhere
from tofcorr.diagnosis.given.simulator import GivenSimulator
from tofcorr.diagnosis.options import DiagnosisOptions
from tofcorr.diagnosis.sums.base_fit import SimulatorError
from tofcorr.diagnosis.sums.noise import PixelNoise, brightness_of, estimate_noise
from tofcorr.diagnosis.sums.observations import Observations, observe, predicted_distance
from tofcorr.errors import CalibrationDataError
from tofcorr.files import scratch_folder
from tofcorr.geometry.se3 import refuse_unless_rigid

# A frame was rendered at the pose of a recorded one if tool and target differ by no more than this:
# metres for the position of the tool and the distance of the target's plane, radians for the turn
# of either. Chosen: geometry is corrected for the difference, and errors of a camera hardly change.
_TOLERANCE = 1e-3
# Frames within this share of the tolerance of the nearest one are renders of one pose. Chosen: what
# the rounding of a text file leaves.
_SAME_POSE = 0.01
# Relative difference of two equal values of a condition. Chosen: the rounding of a text file.
_SAME_CONDITION = 1e-5


def match_frames(real: Recording, simulated: Recording) -> list[Tensor]:
    """Find the renders of each recorded frame: the nearest pose, the same target and conditions.

    Several renders of one pose all count. A target, a time or another condition chooses among them
    where some of them agree with the recorded frame.

    Args:
        real: The recording.
        simulated: The rendered frames, in any order.
    """
    away = np.max([cdist(*pair) for pair in zip(_places(real), _places(simulated), strict=True)], 0)
    found = away <= np.minimum(away.min(1, keepdims=True) + _SAME_POSE, 1.0)
    alike = [real.frames.target[:, None] == simulated.frames.target]
    for name in CONDITIONS:
        own, others = (getattr(recording.frames, name) for recording in (real, simulated))
        if own is not None and others is not None:
            limit = _SAME_CONDITION * np.abs(own[:, None])
            alike.append(np.abs(others - own[:, None]) <= limit)
    for same in alike:
        found = np.where((found & same).any(1, keepdims=True), found & same, found)
    return [torch.from_numpy(np.flatnonzero(row)) for row in found]


def _places(recording: Recording) -> list[np.ndarray]:
    """Return position and turn of the tool, and normal and distance of the plane there, (F, ...).

    Unit: the tolerance.
    """
    pose = recording.frames.world_from_tool
    normal, offset = (values.numpy() for values in planes_in_tool(recording))
    # A turn by a small angle changes a rotation matrix by sqrt(2) times the angle.
    turn = pose[:, :3, :3].reshape(-1, 9) / np.sqrt(2)
    return [part / _TOLERANCE for part in (pose[:, :3, 3], offset[:, None], turn, normal)]


def repeats_of(recording: Recording) -> np.ndarray:
    """Return a number for each frame without a pose_id; renders of one pose share it, (F,)."""
    table = recording.frames
    _, target = np.unique(table.target, return_inverse=True)
    rows = [np.round(np.concatenate(_places(recording), axis=1) / _SAME_POSE), target[:, None]]
    if table.integration_time is not None:
        rows.append(np.round(np.log(table.integration_time) / _SAME_CONDITION)[:, None])
    keys = np.nan_to_num(np.concatenate(rows, axis=1), nan=-1.0)
    return np.unique(keys, axis=0, return_inverse=True)[1].reshape(-1)


class RenderedSimulator(GivenSimulator):
    """A recording that a simulator rendered; its hand-eye transform and its planes are exact.

    Args:
        recording: The rendered frames.
    """

    kind = "rendered"

    def __init__(self, recording: Recording) -> None:
        self.recording = recording

    def rendered_frames(self, recording: Recording) -> Recording:
        """Return the rendered frames, whichever poses they show."""
        del recording
        return self.recording

    def simulate(self, observations: Observations, options: DiagnosisOptions) -> SimulatorError:
        """Compare pixel by pixel at the same poses; at others, through the covariates."""
        refuse_other_camera(observations.recording, self.recording)
        frames = observe(self.recording, options.most_pixels)
        if self.recording.frames.pose_id is None:
            frames = replace(frames, unit=torch.from_numpy(repeats_of(self.recording)))
        if self.recording.true_depth is None:
            refuse_without_truth(self.recording, frames)
            refuse_mistaken_geometry(self.recording)
        pose = torch.from_numpy(self.recording.tool_from_camera)
        noise = estimate_noise(frames, pose)
        matches = match_frames(observations.recording, self.recording)
        # Where half of the recorded frames have no render, renders of other poses say more.
        missing = sum(len(found) == 0 for found in matches)
        if missing > len(matches) / 2:
            return simulated_elsewhere(frames, observations, options)
        error, sigma = _pixel_by_pixel(frames, noise, matches, observations)
        known = SimulatorError.exact(error, pose, sigma)
        if not missing:
            return known
        limit = (
            f"{self.recording.path}: {missing} of {len(matches)} recorded frames were not "
            "rendered (no pose within 1 mm and 1 mrad); they are left out."
        )
        return replace(known, limits=(limit,))


def _pixel_by_pixel(
    frames: Observations, noise: PixelNoise, matches: Sequence[Tensor], real: Observations
) -> tuple[Tensor, Tensor]:
    """Return the mean error of the renders in each chosen pixel, and its standard deviation, (M,).

    The truth of a render is the plane at the render's own pose, so that a pose that was rounded
    differently changes nothing.
    """
    pose = torch.from_numpy(frames.recording.tool_from_camera)
    row, source = [], []
    for renders, (start, end) in zip(matches, real.frame_ends, strict=True):
        row.append(torch.arange(start, end).repeat(len(renders)))
        source.append(renders.repeat_interleave(end - start))
    row = torch.cat(row)
    seen = frames.choosing(torch.cat(source), real.pixel[row])
    truth, spread = predicted_distance(seen, pose), noise.at(brightness_of(seen), seen.frame)
    usable, full = frames.usable, frames.recording.saturation_amplitude
    if full is not None and frames.amplitude_images is not None:
        usable &= frames.amplitude_images < full
    use = usable.flatten(1)[seen.frame, seen.pixel] & (truth > 0)

    def total(values: Tensor) -> Tensor:
        return torch.zeros_like(real.measured).index_add(0, row, torch.where(use, values, 0.0))

    count = total(torch.ones_like(truth))
    error = total(seen.measured - truth) / count  # 0 / 0: no render shows this pixel.
    return error, (total(spread**2).sqrt() / count).nan_to_num(0.0)


_KEYS = ("depth", "amplitude", "tool_from_camera")


class PythonSimulator(GivenSimulator):
    """A function that renders the poses of a recording.

    Args:
        function: Takes the recording; returns its frames, an array (N, H, W) of depth in metres,
            of the recording's own kind, NaN or 0 where there is none, or a mapping with `depth`
            and optionally `amplitude` (N, H, W) and `tool_from_camera` (4, 4). Without the last
            the hand-eye transform of the recording is taken to be the simulator's.
    """

    kind = "rendered"

    def __init__(self, function: Callable[[Recording], Any]) -> None:
        self._function = function
        self._rendered: RenderedSimulator | None = None

    def rendered_frames(self, recording: Recording) -> Recording:
        """Return the function's frames as a recording; it is called once."""
        if self._rendered is None:
            self._rendered = self.rendered(recording)
        return self._rendered.recording

    def simulate(self, observations: Observations, options: DiagnosisOptions) -> SimulatorError:
        """Call the function, and compare its frames pixel by pixel."""
        self._rendered = self.rendered(observations.recording)
        with _refused_by_name(self._rendered.recording.path):
            return self._rendered.simulate(observations, options)

    def rendered(self, recording: Recording) -> RenderedSimulator:
        """Call the function, and return its frames as a recording in a temporary folder.

        Raises:
            CalibrationDataError: What it returned does not have the shape of the recording.
        """
        frames = _frames_of(self._function(recording), recording)
        pose = frames.pop("tool_from_camera", recording.tool_from_camera)
        with ExitStack() as stack:
            out = stack.enter_context(scratch_folder()) / "frames"
            with _refused_by_name(out):
                write_recording(
                    out,
                    camera=recording.camera,
                    depth_kind=recording.depth_kind,
                    rows=recording.frames,
                    mask=None if recording.mask is None else np.asarray(recording.mask),
                    modulation_frequency=recording.modulation_frequency,
                    tool_from_camera=pose,
                    **frames,
                )
                simulator = RenderedSimulator(Recording.open(out))
            finalize(simulator, stack.pop_all().close)
        return simulator


@contextmanager
def _refused_by_name(path: Path) -> Iterator[None]:
    """Call the frames what they are in an error, and not by a scratch folder that nobody made."""
    try:
        yield
    except CalibrationDataError as refusal:
        sentence = str(refusal).replace(str(path), "the frames that the function returned")
        raise CalibrationDataError(sentence) from None


def _frames_of(returned: Any, recording: Recording) -> dict[str, Any]:  # noqa: ANN401 - checked here
    """Check what a function returned; return arrays by name."""
    given = dict(returned) if isinstance(returned, Mapping) else {"depth": returned}
    unknown = sorted(set(given) - set(_KEYS))
    if unknown or "depth" not in given:
        raise CalibrationDataError(
            "The simulator must return an array of depth, or a mapping with 'depth' and optionally "
            "'amplitude' and 'tool_from_camera'; it returned "
            f"{', '.join(map(str, given)) or 'nothing'}."
        )
    images = (recording.num_frames, recording.camera.height, recording.camera.width)
    checked = {}
    for name, values in given.items():
        shape, number = images, np.float32
        if name == "tool_from_camera":
            shape, number = (4, 4), np.float64
        try:
            checked[name] = np.asarray(values, dtype=number)
            found = str(checked[name].shape)
        except (TypeError, ValueError, RuntimeError) as error:
            # Of a tensor that has a gradient, or lies on a GPU, torch says what to call first.
            found = f"{type(values).__name__} ({error})"
        if found != str(shape):
            raise CalibrationDataError(
                f"The simulator's {name} must be numbers of the recording's shape {shape}, got "
                f"{found}."
            )
    if "tool_from_camera" in checked:
        try:
            refuse_unless_rigid(checked["tool_from_camera"], UNIT_LENGTH_TOLERANCE)
        except ValueError as error:
            raise CalibrationDataError(f"The simulator's tool_from_camera: {error}.") from None
    return checked
