"""The check in the simulator: with the effects added, the gap must be gone there too.

Each quarter of the poses is simulated with parameters and effects that were fitted to the others.
The choice of effects, and maps with one value a pixel, saw all poses.
"""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from tofcorr.diagnosis.findings.naming import NamedEffects
from tofcorr.diagnosis.rerun.excess import Excess
from tofcorr.diagnosis.rerun.some_poses import fitted_to
from tofcorr.diagnosis.rerun.twin import fitted_distance, simulated_frames
from tofcorr.diagnosis.sums.study import Study
from tofcorr.simulation.options import SimulatorOptions

# Parts of the poses that are held out in turn, whole folds each. Chosen: every part costs a new
# simulator, and three quarters of the poses determine nearly what all do.
_PARTS = 4


@dataclass(frozen=True, kw_only=True)
class Closure:
    """The recording against the simulator run at poses that it was not fitted to, without noise.

    Attributes:
        without_effects: Gap to the simulator with refitted parameters, metres.
        with_effects: Gap to the simulator with the named effects, metres.
        frames: Number of frames simulated.
    """

    without_effects: float
    with_effects: float
    frames: int


def check_in_simulator(
    study: Study, named: NamedEffects, given: SimulatorOptions | None
) -> Closure:
    """Run the simulator without and with the effects, and compare the recording with both.

    Args:
        study: The recording.
        named: The effects named.
        given: The simulator under diagnosis; None: one made from the recording alone.
    """
    frames = simulated_frames(study.observations.recording)
    measured = study.observations.measured
    bare = replace(named, names=(), refined_terms=(), study=study)
    without = with_effects = measured - _held_out(study, bare, given, frames)
    if named.adds_something:
        with_effects = measured - _held_out(study, named, given, frames)
    return Closure(
        without_effects=_gap(study, without),
        with_effects=_gap(study, with_effects),
        frames=len(frames),
    )


def _held_out(
    study: Study, named: NamedEffects, given: SimulatorOptions | None, frames: list[int]
) -> Tensor:
    """Return what the simulator measures, fitted without the poses it is run at, (M,), metres."""
    folds, unit = study.folds, study.observations.unit
    part = folds.argmax(0) * _PARTS // len(folds)
    distance = torch.full_like(study.observations.measured, torch.nan)
    for number in range(_PARTS):
        held_out = part == number
        own = [frame for frame in frames if bool(held_out[unit[frame]])]
        if own:
            fitted = replace(named, study=fitted_to(named.study, ~held_out, named.columns))
            found = fitted_distance(study, fitted, given, None, own)
            distance = torch.where(found.isfinite(), found, distance)
    return distance


def _gap(study: Study, left: Tensor) -> float:
    return Excess.of(study.observations, left, study.fit.share, study.fit.sigma).gap()
