"""Refuses rendered frames that cannot be compared, or whose geometry is not what they say."""

import math

import numpy as np
import torch

from tofcorr.data.recording import Recording
from tofcorr.diagnosis.sums.observations import TINY, Observations, predicted_distance
from tofcorr.errors import CalibrationDataError, ConfigError
from tofcorr.geometry import se3
from tofcorr.geometry.rays import ray_directions
from tofcorr.options import resolve_options
from tofcorr.pixels.dataset import Dataset
from tofcorr.plausibility.alignment import Alignment, judged
from tofcorr.plausibility.checks.geometry import agreement
from tofcorr.plausibility.look import Look
from tofcorr.simulation.options import SimulatorOptions


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
            f"{real.path}; render with the recording's own K and distortion (recording.yaml: "
            "camera)."
        )


def refuse_without_truth(simulated: Recording, observations: Observations) -> None:
    """Refuse frames that disagree with their own geometry beyond what any camera does.

    Args:
        simulated: The rendered frames.
        observations: Their pixels.

    Raises:
        CalibrationDataError: Planes, hand-eye transform, axes, unit or kind of depth are wrong.
    """
    if simulated.planes == "estimated":
        raise CalibrationDataError(
            f"{simulated.path}: its planes are estimated from the depth (recording.yaml: planes); "
            "a simulator knows its walls: write them to frames.csv."
        )
    pose = torch.from_numpy(simulated.tool_from_camera)
    difference = observations.measured - predicted_distance(observations, pose)
    off = float(difference.abs().nan_to_num(torch.inf).median())
    other = "z" if simulated.depth_kind == "radial" else "radial"
    cosine = ray_directions(simulated.camera).reshape(-1, 3)[observations.pixel, 2]
    factor = 1 / cosine if other == "z" else cosine
    # The slope of a line through the differences of pixels whose plane is known.
    between = (observations.measured * (factor - 1))[difference.isfinite()]
    between = between - between.mean()
    slope = float(between @ difference[difference.isfinite()] / (between @ between).clamp(min=TINY))
    # It is 0 if the kind of depth is right, and -1 if it is the other one.
    if abs(slope + 1) < 0.3:
        raise CalibrationDataError(
            f"{simulated.path}: its depth differs from its own planes as depth_kind {other} "
            f"does from {simulated.depth_kind}; render {simulated.depth_kind} depth, or correct "
            "depth_kind in their own recording.yaml."
        )
    # No depth camera is as wrong, and every mistaken axis or unit gives more.
    if not off <= 0.3:
        raise CalibrationDataError(
            f"{simulated.path}: its depth is {off:.2f} m off from its own planes; check "
            "tool_from_camera and its axes (x right, y down, z forward), the planes in "
            "frames.csv, and the unit of depth.npy (metres)."
        )


# Where `simulation.simulator` keeps its options in a recording.
_OPTIONS_OF_SIMULATE = "truth/options.yaml"


def refuse_mistaken_geometry(simulated: Recording) -> None:
    """Refuse frames that a usual mistake keeps from agreeing with their own planes.

    The recording under diagnosis is looked at in the same way. The hand-eye transform of a
    simulator is exact besides.

    Raises:
        CalibrationDataError: Images are mirrored, poses inverted, or the like, or tool_from_camera
            is not that of the simulator.
    """
    if simulated.moves:
        _refuse_guess(simulated)
    look = Look(Dataset((simulated,)))
    found = [one.sentence for one in agreement(look) if one.severity == "impossible"]
    if found:
        raise CalibrationDataError(f"{simulated.path}: {' '.join(found)}")
    if look.as_given is not None and simulated.moves:
        _refuse_other_mounting(simulated, look, look.as_given)


def _refuse_guess(simulated: Recording) -> None:
    """Refuse a transform that `tofcorr simulate` wrote as a guess, however close it is."""
    path = simulated.path / _OPTIONS_OF_SIMULATE
    if not path.exists():
        return
    try:
        true = resolve_options(SimulatorOptions, path).hand_eye.tool_from_camera()
    except ConfigError:  # Not a file of this program: the frames themselves tell.
        return
    shift, turn = se3.apart(true, torch.as_tensor(simulated.tool_from_camera))
    # A tenth of the least gap that matters, metres and radians.
    if max(shift, turn) <= 1e-4:
        return
    raise CalibrationDataError(
        f"{simulated.path}: its tool_from_camera is a guess, as a robot's user would make it: "
        f"{1e3 * shift:.3g} mm and {math.degrees(turn):.2g} degrees from the true one. Give the "
        "configuration of `tofcorr simulate` to --sim in place of this recording, or simulate with "
        "--set hand_eye.guess.translation_mm=0 --set hand_eye.guess.rotation_deg=0."
    )


def _refuse_other_mounting(simulated: Recording, look: Look, best: Alignment) -> None:
    """Refuse a transform far from where the frames agree with their planes.

    Errors of a depth camera move it by millimetres and tenths of a degree, not by 50 mm or two
    degrees. Directions that the frames do not determine leave no misfit.
    """
    stated = np.asarray(simulated.tool_from_camera)
    shift, turn = se3.apart(torch.as_tensor(stated), torch.as_tensor(best.hand_eye))
    if shift <= 0.05 and turn <= math.radians(2.0):
        return
    misfit = judged(look.scene, stated, best.constant, best.slope).misfit
    if misfit > max(0.02, 4 * best.misfit):
        raise CalibrationDataError(
            f"{simulated.path}: its frames agree with its planes if the camera sits "
            f"{1e3 * shift:.0f} mm and {math.degrees(turn):.1f} degrees from its "
            "tool_from_camera; write the one that they were rendered with."
        )
