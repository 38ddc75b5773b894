"""Refuses rendered frames whose images, poses or mounting are not what they say."""

import math

import numpy as np
import torch

from tofcorr.data.recording import Recording
from tofcorr.errors import CalibrationDataError, ConfigError
from tofcorr.geometry import se3
from tofcorr.options import resolve_options
from tofcorr.pixels.dataset import Dataset
from tofcorr.plausibility.alignment import Alignment, judged
from tofcorr.plausibility.checks import agreement
from tofcorr.plausibility.look import Look
from tofcorr.plausibility.sample import read_sample
from tofcorr.simulation.options import SimulatorOptions

# A tool_from_camera farther than this from where the frames agree with their planes, metres and
# radians, is not the one that they were rendered with. Chosen: errors of a depth camera move it by
# millimetres and tenths of a degree.
_SAME_PLACE, _SAME_ANGLE = 0.05, math.radians(2.0)
# A transform this far from the true one, metres and radians, is it. Chosen: a tenth of the least
# gap that matters.
_EXACT = 1e-4
# Where `simulation.simulator` keeps its options in a recording.
_OPTIONS_OF_SIMULATE = "truth/options.yaml"
# The stated transform counts as wrong only if it leaves this many times the misfit of the best one,
# and more than this many metres. Chosen: directions that the frames do not determine leave no more.
_TIMES_WORSE, _LEAST_MISFIT = 4.0, 0.02


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
    look = Look(read_sample(Dataset((simulated,))))
    found = [one.sentence for one in agreement.check(look) if one.severity == "impossible"]
    if found:
        raise CalibrationDataError(f"{simulated.path}: {' '.join(found)}")
    best = look.as_given
    if best is not None and simulated.moves:
        _refuse_other_mounting(simulated, look, best)


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
    if max(shift, turn) <= _EXACT:
        return
    raise CalibrationDataError(
        f"{simulated.path}: its tool_from_camera is a guess, as a robot's user would make it: "
        f"{1e3 * shift:.3g} mm and {math.degrees(turn):.2g} degrees from the true one. Give the "
        "configuration of `tofcorr simulate` to --sim in place of this recording, or simulate with "
        "--set hand_eye.guess.translation_mm=0 --set hand_eye.guess.rotation_deg=0."
    )


def _refuse_other_mounting(simulated: Recording, look: Look, best: Alignment) -> None:
    stated = np.asarray(simulated.tool_from_camera)
    shift, turn = se3.apart(torch.as_tensor(stated), torch.as_tensor(best.hand_eye))
    if shift <= _SAME_PLACE and turn <= _SAME_ANGLE:
        return
    misfit = judged(look.scene, stated, best.constant, best.slope).misfit
    if misfit > max(_LEAST_MISFIT, _TIMES_WORSE * best.misfit):
        raise CalibrationDataError(
            f"{simulated.path}: its frames agree with its planes if the camera sits "
            f"{1e3 * shift:.0f} mm and {math.degrees(turn):.1f} degrees from its "
            "tool_from_camera; write the one that they were rendered with."
        )
