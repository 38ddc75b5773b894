"""Closing the loop: the effect goes into the simulator, and the gap must be gone there."""

from dataclasses import dataclass

import torch
from torch import Tensor

from tofcorr.diagnosis.findings.select import Selection, least_p_value
from tofcorr.diagnosis.findings.which import compare
from tofcorr.diagnosis.rerun.fitted_simulator import simulator_of, solution_of
from tofcorr.diagnosis.rerun.twin import simulated_frames, twin_distance
from tofcorr.diagnosis.sums.study import Study
from tofcorr.simulation.options import SimulatorOptions


@dataclass(frozen=True, kw_only=True)
class Closure:
    """The recording against the simulator run anew, noise-free, at its poses.

    Attributes:
        without_effects: Gap to the simulator with refitted parameters, metres.
        with_effects: Gap to the simulator with the effects named, metres.
        p_value: Of the whole diagnosis against the simulator with effects; None if only some
            frames were simulated or there are too few poses.
        frames: How many frames were simulated.
    """

    without_effects: float
    with_effects: float
    p_value: float | None
    frames: int


def close_the_loop(study: Study, selection: Selection, given: SimulatorOptions | None) -> Closure:
    """Run the simulator without and with the effects, and compare the recording with both."""
    frames = simulated_frames(study.observations)
    gaps = []
    left = torch.zeros_like(study.residual)
    for model in (None, selection):
        simulator = simulator_of(study, model, given)
        pose = solution_of(study, model)[0]
        twin = twin_distance(study.observations, simulator, pose, None, frames)
        left = study.observations.measured - twin
        gaps.append(_gap(study, left))
    whole = len(frames) == study.observations.num_frames and selection.tested
    return Closure(
        without_effects=gaps[0],
        with_effects=gaps[1],
        p_value=_against(study, left) if whole else None,
        frames=len(frames),
    )


def _gap(study: Study, left: Tensor) -> float:
    share = study.fit.share * left.isfinite()
    square = float((share * left.nan_to_num(0.0) ** 2).sum() / share.sum())
    floor = float((share * study.fit.sigma**2).sum() / share.sum())
    return max(square - floor, 0.0) ** 0.5


def _against(study: Study, left: Tensor) -> float:
    """Return the p-value of the best effect where the residual is that to the new twin."""
    anew = study.with_residual(torch.where(left.isfinite(), left, 0.0))
    return least_p_value(anew, compare(anew, ()))
