"""A simulator that a user named: options of the built-in one, or frames that any other rendered.

Options are run without noise at the recording's poses. Frames are written as a recording, or
returned by a Python function; each frame of the recording is compared with the renders that show
what it shows. Frames that cannot be compared, or whose geometry is not what they say, are refused.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from tofcorr.conditions import CONDITIONS
from tofcorr.data.arrays import IMAGE_ARRAYS
from tofcorr.data.recording import (
    Recording,
    planes_in_tool,
)
from tofcorr.diagnosis.elsewhere import simulated_elsewhere
from tofcorr.diagnosis.options import DiagnosisOptions
from tofcorr.diagnosis.rerun.simulator import twin_distance
from tofcorr.diagnosis.sums.base import SimulatorError
from tofcorr.diagnosis.sums.noise import PixelNoise, brightness_of, estimate_noise
from tofcorr.diagnosis.sums.observations import (
    Observations,
    observe,
    predicted_distance,
)
from tofcorr.errors import CalibrationDataError, ConfigError
from tofcorr.geometry import se3
from tofcorr.geometry.rays import ray_directions
from tofcorr.options import resolve_options
from tofcorr.pixels.dataset import Dataset
from tofcorr.plausibility.alignment import Alignment, judged
from tofcorr.plausibility.checks.geometry import agreement, shape
from tofcorr.plausibility.finding import CAMERA, SIGMAS, WORTH_A_WORD
from tofcorr.plausibility.linear import exact_camera
from tofcorr.plausibility.look import Look
from tofcorr.simulation.options import SimulatorOptions
from tofcorr.simulation.simulator import default_hand_eye

SimulatorKind = Literal["given", "rendered", "fitted"]
"""`given`: options of the built-in simulator; `rendered`: frames of any other; `fitted`: none was
named, so that a simulator is fitted to the recording."""


OpenSimulator = SimulatorOptions | Recording
"""Options of the built-in simulator, or the frames that another one rendered; their hand-eye
transform and planes are exact."""


def simulated_error(
    simulator: OpenSimulator, observations: Observations, options: DiagnosisOptions
) -> SimulatorError:
    """Return the error that a simulator makes in the chosen pixels of a recording.

    Raises:
        CalibrationDataError: The simulator cannot be compared with the recording.
    """
    if isinstance(simulator, Recording):
        return rendered_error(simulator, observations, options)
    pose = default_hand_eye(simulator, observations.recording)
    distance = twin_distance(observations, simulator, pose)
    return SimulatorError.exact(distance - predicted_distance(observations, pose), pose)


Simulator = SimulatorOptions | Mapping[str, Any] | Path | str | Recording | Callable[..., Any]
"""All that `diagnose` accepts as a simulator."""


def open_simulator(sim: Simulator | None, recording: Recording) -> OpenSimulator | None:
    """Return the simulator that `sim` names; None for None.

    Args:
        sim: The name of a shipped configuration, a YAML file, keys and values or options of the
            built-in simulator; a recording that any simulator rendered, or its folder; or a
            function from a recording to frames at its poses.
        recording: The real recording.

    Raises:
        ConfigError: There is no such configuration, a key is unknown, or it is something else, such
            as an array.
        CalibrationDataError: The folder is not a recording, or the function does not return frames
            of the recording's shape.
    """
    if sim is None or isinstance(sim, Recording):
        return sim
    if isinstance(sim, str | Path) and Path(sim).is_dir():
        return Recording.open(sim)
    if callable(sim):
        return frames_of(sim(recording), recording)
    if not isinstance(sim, SimulatorOptions | Mapping | str | Path):
        raise ConfigError(
            "sim: expected a shipped name, a file, options, a recording or a function, got "
            f"{type(sim).__name__}. Frames in memory are handed over by a function: "
            "sim=lambda recording: frames."
        )
    return resolve_options(SimulatorOptions, sim)


def frames_of(returned: Any, recording: Recording) -> Recording:  # noqa: ANN401 - checked here
    """Check what a function returned for a recording; return it as a recording in memory.

    Args:
        returned: Depth in metres, an array (N, H, W), of the recording's own kind, NaN or 0 where
            there is none; or a mapping with `depth` and optionally `amplitude` (N, H, W) and
            `tool_from_camera` (4, 4). Without the last the hand-eye transform of the recording is
            taken to be the simulator's.
        recording: The real recording.

    Raises:
        CalibrationDataError: It does not have the shape of the recording.
    """
    given = dict(returned) if isinstance(returned, Mapping) else {"depth": returned}
    if "depth" not in given or not given.keys() <= {"depth", "amplitude", "tool_from_camera"}:
        raise CalibrationDataError(
            "The simulator must return an array of depth, or a mapping with 'depth' and optionally "
            "'amplitude' and 'tool_from_camera'; it returned "
            f"{', '.join(map(str, given)) or 'nothing'}."
        )
    source = Path("the frames that the function returned")
    images = (recording.num_frames, recording.camera.height, recording.camera.width)
    checked: dict[str, Any] = {"amplitude": None}
    for name, values in given.items():
        of_pose = name == "tool_from_camera"
        shape, number = ((4, 4), np.float64) if of_pose else (images, np.float32)
        try:
            checked[name] = np.asarray(values, dtype=number)
            found = str(checked[name].shape)
        except (TypeError, ValueError, RuntimeError) as error:
            # Of a tensor that has a gradient, or lies on a GPU, torch says what to call first.
            found = f"{type(values).__name__} ({error})"
        if found != str(shape):
            raise CalibrationDataError(
                f"The simulator's {name} must be numbers of the shape {shape}, got {found}."
            )
        if not of_pose:
            IMAGE_ARRAYS[name].check(checked[name], range(recording.num_frames), source)
            continue
        try:
            se3.refuse_unless_rigid(checked[name])
        except ValueError as error:
            raise CalibrationDataError(f"The simulator's tool_from_camera: {error}.") from None
        checked[name] = se3.nearest_rigid(checked[name])
    return replace(
        recording,
        path=source,
        saturation_amplitude=None,
        raw=None,
        true_depth=None,
        planes="recorded",
        **checked,
    )


# A frame was rendered at the pose of a recorded one if tool and target differ by no more than this:
# metres for the position of the tool and the distance of the target's plane, radians for the turn
# of either. Chosen: geometry is corrected for the difference, and errors of a camera hardly change.
_TOLERANCE = 1e-3
# What the rounding of a text file changes at most: metres and radians of a pose or a plane, and a
# share of a condition. Chosen.
_ROUNDING = 1e-5


def match_frames(real: Recording, simulated: Recording) -> list[Tensor]:
    """Find the renders of each recorded frame: the nearest pose, the same target and conditions.

    Several renders of one pose all count. A target, a time or another condition chooses among them
    where some of them agree with the recorded frame.

    Args:
        real: The recording.
        simulated: The rendered frames, in any order.
    """
    places = zip(_places(real), _places(simulated), strict=True)
    # By differences: the product of all places has no digits left for those that are near.
    exact = "donot_use_mm_for_euclid_dist"
    apart = [torch.cdist(own, other, compute_mode=exact) for own, other in places]
    away = torch.stack(apart).amax(0).numpy()
    found = away <= np.minimum(away.min(1, keepdims=True) + _ROUNDING, _TOLERANCE)
    alike = [real.frames.target[:, None] == simulated.frames.target]
    for name in CONDITIONS:
        own, others = (getattr(recording.frames, name) for recording in (real, simulated))
        if own is not None and others is not None:
            alike.append(np.abs(others - own[:, None]) <= _ROUNDING * np.abs(own[:, None]))
    for same in alike:
        found = np.where((found & same).any(1, keepdims=True), found & same, found)
    return [torch.from_numpy(np.flatnonzero(row)) for row in found]


def _places(recording: Recording) -> list[Tensor]:
    """Return position and turn of the tool, and normal and distance of the plane there, (F, ...).

    In metres and radians.
    """
    pose = torch.from_numpy(recording.frames.world_from_tool)
    normal, offset = planes_in_tool(recording)
    # A turn by a small angle changes a rotation matrix by sqrt(2) times the angle.
    turn = pose[:, :3, :3].reshape(-1, 9) / math.sqrt(2)
    return [pose[:, :3, 3], offset[:, None], turn, normal]


def rendered_error(
    rendered: Recording, observations: Observations, options: DiagnosisOptions
) -> SimulatorError:
    """Compare frames pixel by pixel at the same poses; at others, through the covariates.

    Args:
        rendered: The frames; their hand-eye transform and their planes are exact.
        observations: Of the real recording.
        options: Of the diagnosis.

    Raises:
        CalibrationDataError: The frames cannot be compared with the recording.
    """
    refuse_other_camera(observations.recording, rendered)
    frames = observe(rendered, options.most_pixels)
    limits = [] if rendered.true_depth is not None else refuse_mistaken_geometry(rendered)
    pose = torch.from_numpy(rendered.tool_from_camera)
    noise = estimate_noise(frames, pose)
    matches = match_frames(observations.recording, rendered)
    # Where half of the recorded frames have no render, renders of other poses say more.
    missing = sum(len(found) == 0 for found in matches)
    if missing > len(matches) / 2:
        known = simulated_elsewhere(frames, observations, options)
    else:
        error, sigma = _pixel_by_pixel(frames, noise, matches, observations)
        known = SimulatorError.exact(error, pose, sigma)
        if missing:
            limits.append(
                f"{rendered.path}: {missing} of {len(matches)} recorded frames were not "
                "rendered (no pose within 1 mm and 1 mrad); they are left out."
            )
    return replace(known, limits=(*limits, *known.limits))


def _looks_beside(look: Look, stated: Alignment) -> list[str]:
    """Say by how much frames look beside where their camera matrix says, if they surely do.

    Args:
        look: The frames.
        stated: Under their own hand-eye transform, which is exact, as their planes are.
    """
    recording = look.recording
    found, moved = exact_camera(look.near(stated), recording.depth_kind)
    sure = np.sqrt(np.square(moved).mean(0)) >= WORTH_A_WORD
    sure &= np.abs(found.value) >= SIGMAS * found.error
    if not sure.any():
        return []
    # A focal length longer by a share k makes x and y shorter by k / (1 + k).
    focal, longer = np.diag(recording.camera.matrix)[:2], 1 / (1 - found.value[2:])
    value = [*(found.value[:2] * longer * focal), *(longer - 1)]
    named = ("{:+.2f} px in x", "{:+.2f} px in y", "{:+.2%} of fx", "{:+.2%} of fy")
    said = ", ".join(named[k].format(value[k]) for k in np.flatnonzero(sure))
    off = 1e3 * float(np.sqrt(np.square(moved[:, sure].sum(1)).mean()))
    return [
        f"{recording.path}: its frames agree with their planes if the camera matrix of "
        f"recording.yaml changes by {said}; as it is, they are {off:.1f} mm off. Does the "
        "renderer count pixel centres otherwise?"
    ]


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


def refuse_other_camera(real: Recording, simulated: Recording) -> None:
    """Refuse frames of another image size or of other viewing rays.

    Two cameras are the same if no pixel's ray differs by more than a hundredth of a pixel: at an
    incidence of 45 degrees it changes a distance of 1 m by 0.1 mm at 100 pixels of focal length.

    Args:
        real: The recording.
        simulated: The rendered frames.

    Raises:
        CalibrationDataError: The cameras differ; the sentence says by how much.
    """
    one, other = real.camera, simulated.camera
    if (one.width, one.height) != (other.width, other.height):
        raise CalibrationDataError(
            f"{simulated.path}: its images have {other.width} x {other.height} pixels, those of "
            f"{real.path} {one.width} x {one.height}; render with the recording's own camera."
        )
    apart = (ray_directions(one) - ray_directions(other)).norm(dim=-1).max()
    pixels = float(apart) * max(one.matrix[0][0], one.matrix[1][1])
    if not 100 * pixels <= 1:
        raise CalibrationDataError(
            f"{simulated.path}: its pixels look up to {pixels:.2g} pixels beside those of "
            f"{real.path}; render with the K and distortion of its recording.yaml."
        )


def refuse_mistaken_geometry(simulated: Recording) -> list[str]:
    """Refuse frames that a usual mistake keeps from agreeing with their own planes.

    The recording under diagnosis is looked at in the same way. The hand-eye transform of a
    simulator is exact besides.

    Returns:
        What limits a comparison with the frames, a sentence each.

    Raises:
        CalibrationDataError: Images are mirrored, poses inverted, the unit or kind of depth is
            wrong, or the like; planes are estimated, or tool_from_camera is not the simulator's.
    """
    if simulated.planes == "estimated":
        raise CalibrationDataError(
            f"{simulated.path}: its planes are estimated from the depth (recording.yaml: planes); "
            "a simulator knows its walls: write them to frames.csv."
        )
    if simulated.moves:
        _refuse_guess(simulated)
    look = Look(Dataset((simulated,)))
    odd = (one.sentence for one in (*shape(look), *agreement(look)) if one.severity == "impossible")
    first = next(odd, None)
    if first is not None:
        raise CalibrationDataError(f"{simulated.path}: {first}")
    best, mount = look.as_given, np.asarray(simulated.tool_from_camera)
    if best is None:
        return []
    # Directions that the frames do not determine leave no misfit.
    stated = judged(look.scene, mount, best.constant, best.slope)
    if simulated.moves and stated.misfit > max(CAMERA, 4 * best.misfit):
        shift, turn = se3.apart(torch.as_tensor(mount), torch.as_tensor(best.hand_eye))
        raise CalibrationDataError(
            f"{simulated.path}: its frames agree with its planes if the camera sits "
            f"{1e3 * shift:.0f} mm and {math.degrees(turn):.1f} degrees from its "
            "tool_from_camera; write the one that they were rendered with."
        )
    return [] if look.linear is None else _looks_beside(look, stated)


def _refuse_guess(simulated: Recording) -> None:
    """Refuse a transform that `tofcorr simulate` wrote as a guess, however close it is."""
    path = simulated.path / "truth/options.yaml"  # `simulation.simulator` writes it.
    if not path.exists():
        return
    try:
        true = resolve_options(SimulatorOptions, path).hand_eye.tool_from_camera()
    except ConfigError:  # Not a file of this program: the frames themselves tell.
        return
    shift, turn = se3.apart(true, torch.as_tensor(simulated.tool_from_camera))
    if max(shift, turn) <= _ROUNDING:
        return
    raise CalibrationDataError(
        f"{simulated.path}: its tool_from_camera is a guess, as a robot's user would make it: "
        f"{1e3 * shift:.3g} mm and {math.degrees(turn):.2g} degrees from the true one. Give the "
        "configuration of `tofcorr simulate` to --sim in place of this recording, or simulate with "
        "--set hand_eye.guess.translation_mm=0 --set hand_eye.guess.rotation_deg=0."
    )
