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
from torch import Tensor

from tofcorr.conditions import CONDITIONS
from tofcorr.data.recording import Recording, planes_in_tool, refuse_unless_rigid
from tofcorr.data.writing import write_recording
from tofcorr.diagnosis.given.checks import (
    refuse_mistaken_geometry,
    refuse_other_camera,
    refuse_without_truth,
)
from tofcorr.diagnosis.given.elsewhere import has_true_depth, simulated_elsewhere
from tofcorr.diagnosis.given.simulator import GivenSimulator, Simulated
from tofcorr.diagnosis.options import DiagnosisOptions
from tofcorr.diagnosis.sums.base_fit import SimulatorError
from tofcorr.diagnosis.sums.noise import PixelNoise, estimate_noise, inverse_square
from tofcorr.diagnosis.sums.observations import Observations, observe
from tofcorr.errors import CalibrationDataError
from tofcorr.files import scratch_folder
from tofcorr.geometry.rays import distance_along_rays, ray_directions

# A frame was rendered at the pose of a recorded one if tool and target differ by no more than this:
# metres for the position of the tool and the distance of the target's plane, radians for the turn
# of either. Chosen: geometry is corrected for the difference, and errors of a camera hardly change.
_TOLERANCE = 1e-3
# Frames within this share of the tolerance of the nearest one are renders of one pose. Chosen: what
# the rounding of a text file leaves.
_SAME_POSE = 0.01
# Relative difference of two equal values of a condition. Chosen: the rounding of a text file.
_SAME_CONDITION = 1e-5
# Poses are matched if this share of the recorded frames has a render; otherwise the simulator is
# taken to have seen other poses. Chosen: with fewer, a render of other poses says more.
_LEAST_MATCHED = 0.5


def match_frames(real: Recording, simulated: Recording) -> list[Tensor]:
    """Find the renders of each recorded frame: the nearest pose, the same target and conditions.

    Several renders of one pose all count. A target, a time or another condition chooses among them
    where some of them agree with the recorded frame.

    Args:
        real: The recording.
        simulated: The rendered frames, in any order.
    """
    here, there = _places(real), _places(simulated)
    renders = []
    for frame, place in enumerate(here):
        away = _difference(place, there)
        near = np.flatnonzero(away <= min(away.min() + _SAME_POSE, 1.0))
        renders.append(torch.from_numpy(_alike(real, simulated, frame, near)))
    return renders


def _places(recording: Recording) -> np.ndarray:
    """Return position and rotation of the tool, normal and distance of the plane there, (F, 16)."""
    pose = recording.frames.world_from_tool
    normal, offset = (values.numpy() for values in planes_in_tool(recording))
    return np.concatenate(
        [pose[:, :3, 3], offset[:, None], pose[:, :3, :3].reshape(-1, 9), normal], axis=1
    )


def _difference(place: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return the largest difference in units of the tolerance, shape (S,)."""
    apart = others - place
    # A turn by a small angle changes a rotation matrix by sqrt(2) times the angle.
    sizes = [
        np.linalg.norm(apart[:, :3], axis=1),
        np.abs(apart[:, 3]),
        np.linalg.norm(apart[:, 4:13], axis=1) / np.sqrt(2),
        np.linalg.norm(apart[:, 13:], axis=1),
    ]
    return np.max(sizes, axis=0) / _TOLERANCE


def _alike(real: Recording, simulated: Recording, frame: int, near: np.ndarray) -> np.ndarray:
    """Keep the renders whose target, and then each condition, agree; all where none agrees."""
    tables = real.frames, simulated.frames
    agree = [tables[1].target[near] == tables[0].target[frame]]
    for name in CONDITIONS:
        own, others = (getattr(table, name) for table in tables)
        if own is not None and others is not None:
            apart = np.abs(others[near] - own[frame])
            agree.append(apart <= _SAME_CONDITION * abs(float(own[frame])))
    kept = np.ones(len(near), dtype=bool)
    for same in agree:
        if (kept & same).any():
            kept &= same
    return near[kept]


def repeats_of(recording: Recording) -> np.ndarray:
    """Return a number for each frame without a pose_id; renders of one pose share it, (F,)."""
    table = recording.frames
    _, target = np.unique(table.target, return_inverse=True)
    rows = [np.round(_places(recording) / (_SAME_POSE * _TOLERANCE)), target[:, None]]
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

    def simulate(self, observations: Observations, options: DiagnosisOptions) -> Simulated:
        """Compare pixel by pixel at the same poses; at others, through the covariates."""
        refuse_other_camera(observations.recording, self.recording)
        frames = observe(self.recording, options.most_pixels)
        if self.recording.frames.pose_id is None:
            frames = replace(frames, unit=torch.from_numpy(repeats_of(self.recording)))
        if not has_true_depth(self.recording):
            refuse_without_truth(self.recording, frames)
            refuse_mistaken_geometry(self.recording)
        pose = torch.from_numpy(self.recording.tool_from_camera)
        noise = estimate_noise(frames, pose)
        matches = match_frames(observations.recording, self.recording)
        missing = sum(len(found) == 0 for found in matches)
        if 1 - missing / len(matches) < _LEAST_MATCHED:
            return simulated_elsewhere(frames, observations, options)
        error, sigma = _pixel_by_pixel(frames, noise, matches, observations)
        warning = (
            f"{self.recording.path}: {missing} of {len(matches)} recorded frames were not "
            "rendered (no pose within 1 mm and 1 mrad); they are left out."
        )
        known = SimulatorError.exact(error, pose, sigma)
        return Simulated(known, (warning,) if missing else ())


def _pixel_by_pixel(
    frames: Observations, noise: PixelNoise, matches: Sequence[Tensor], real: Observations
) -> tuple[Tensor, Tensor]:
    """Return the mean error of the renders in each chosen pixel, and its standard deviation, (M,).

    The truth of a render is the plane at the render's own pose, so that a pose that was rounded
    differently changes nothing.
    """
    pose = torch.from_numpy(frames.recording.tool_from_camera)
    world_from_camera = frames.facts.world_from_tool @ pose
    rays = ray_directions(frames.recording.camera).reshape(-1, 3)
    usable, images = frames.usable, frames.amplitude_images
    full = frames.recording.saturation_amplitude
    if full is not None and images is not None:
        usable &= images < full
    error = torch.full_like(real.measured, torch.nan)
    sigma = torch.zeros_like(real.measured)
    for frame, (start, end) in enumerate(real.frame_ends):
        renders = matches[frame]
        if end == start or len(renders) == 0:
            continue
        pixel = real.pixel[start:end].repeat(len(renders))
        source = renders.repeat_interleave(end - start)
        truth = distance_along_rays(
            rays[pixel], source, world_from_camera, frames.facts.normal_world, frames.facts.offset
        )
        simulated = frames.distance_images.flatten(1)[source, pixel].double()
        use = usable.flatten(1)[source, pixel] & (truth > 0)
        bright = inverse_square(simulated)
        if images is not None:
            bright = images.flatten(1)[source, pixel].double()
        spread = noise.at(bright, source)
        shape = (len(renders), end - start)
        count = use.reshape(shape).sum(0)
        total = torch.where(use, simulated - truth, 0.0).reshape(shape).sum(0)
        squares = torch.where(use, spread**2, 0.0).reshape(shape).sum(0)
        error[start:end] = total / count  # 0 / 0: no render shows this pixel.
        sigma[start:end] = (squares.sqrt() / count).nan_to_num(0.0)
    return error, sigma


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

    def simulate(self, observations: Observations, options: DiagnosisOptions) -> Simulated:
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
    shape = (recording.num_frames, recording.camera.height, recording.camera.width)
    expected = {"depth": shape, "amplitude": shape, "tool_from_camera": (4, 4)}
    checked = {}
    for name, values in given.items():
        try:
            array = np.asarray(values, dtype=np.float64 if expected[name] == (4, 4) else np.float32)
        except (TypeError, ValueError, RuntimeError) as error:
            # Of a tensor that has a gradient, or lies on a GPU, torch says what to call first.
            raise CalibrationDataError(
                f"The simulator's {name} must be numbers of shape {expected[name]}, got "
                f"{type(values).__name__} ({error})"
            ) from None
        if array.shape != expected[name]:
            raise CalibrationDataError(
                f"The simulator's {name} must have the recording's shape {expected[name]}, got "
                f"{array.shape}."
            )
        checked[name] = array
    if "tool_from_camera" in checked:
        try:
            refuse_unless_rigid(checked["tool_from_camera"])
        except ValueError as error:
            raise CalibrationDataError(f"The simulator's tool_from_camera: {error}.") from None
    return checked
