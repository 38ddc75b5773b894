"""The gap that degraded ideal frames leave at poses held out from the fit of their sensor."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from warnings import catch_warnings, simplefilter

import numpy as np
import torch
from torch import Tensor

from tofcorr.diagnosis.findings.gap import Interval, interval_of
from tofcorr.diagnosis.findings.naming import NamedEffects
from tofcorr.diagnosis.rerun.excess import Excess
from tofcorr.diagnosis.rerun.expected_images import expected_images, light_images
from tofcorr.diagnosis.rerun.fitted_simulator import observed_by, solution_of
from tofcorr.diagnosis.rerun.found_sensor import sensor_of
from tofcorr.diagnosis.rerun.some_poses import fitted_to
from tofcorr.diagnosis.sums.observations import distance_images
from tofcorr.diagnosis.sums.study import Study
from tofcorr.sensor.model import SensorModel, SensorWarning
from tofcorr.simulation.options import SimulatorOptions

# Pixels that are degraded at most; of larger recordings evenly chosen poses. Chosen: 32 VGA frames,
# some seconds.
_MOST_PIXELS = 10_000_000


@dataclass(frozen=True, kw_only=True)
class DegradedStage:
    """Ideal frames through the sensor that was found, against real frames of other poses.

    Attributes:
        gap: Root mean square in excess of the noise, metres.
        interval: Its 95 % interval, with poses as the unit; the fit is not repeated.
        poses: How many poses were compared.
        left_out: Effects of the sensor that no depth image can show, and why, a sentence each.
    """

    gap: float
    interval: Interval
    poses: int
    left_out: tuple[str, ...]


def degraded_stage(
    study: Study,
    named: NamedEffects,
    simulator: SimulatorOptions | None,
    floor: float,
    resamples: Tensor,
) -> DegradedStage:
    """Fit the sensor without each fold of the poses, and degrade ideal frames of that fold.

    The effects were chosen with all poses; hand-eye transform and coefficients are those of the
    other folds. Ideal frames show the target's plane, and off the target what was measured.

    Args:
        study: The recording, before any effect was named.
        named: The effects named.
        simulator: The built-in simulator with them; None where another one rendered frames.
        floor: Noise of a pixel, root mean square, metres, as in the other stages.
        resamples: How often each resample holds each pose, shape (B, U).
    """
    observations, share = study.observations, study.fit.share
    chosen = _chosen_units(study)
    squares, weights = torch.zeros(2, observations.num_units, dtype=torch.float64)
    left_out: tuple[str, ...] = ()
    for held in _folds(study, chosen):
        own = _without(study, held, named.columns)
        model_named = replace(named, study=_without(named.study, held, named.columns))
        with catch_warnings():
            simplefilter("ignore", SensorWarning)  # `left_out` says so once, and not in each fold.
            model = SensorModel(sensor_of(own, model_named, simulator, None), torch.float64)
            left_out = model.left_out
            frames = torch.nonzero(held[observations.unit]).reshape(-1)
            pixels = held[study.unit_of_pixel].nonzero().reshape(-1)
            expected = _expected(model, own, model_named, frames)
        place = torch.full((observations.num_frames,), -1)
        place[frames] = torch.arange(len(frames))
        of_pixel = expected[place[observations.frame[pixels]], observations.pixel[pixels]]
        residual = observations.measured[pixels] - of_pixel
        known = share[pixels] * residual.isfinite()
        unit = study.unit_of_pixel[pixels]
        squares = squares.index_add(0, unit, known * residual.nan_to_num(0.0) ** 2)
        weights = weights.index_add(0, unit, known)
    excess = Excess(squares=squares - floor**2 * weights, weight=weights)
    gap = excess.gap()
    return DegradedStage(
        gap=gap,
        interval=interval_of(excess.gaps(resamples).tolist(), gap),
        poses=len(chosen),
        left_out=left_out,
    )


def _chosen_units(study: Study) -> Tensor:
    """Return the poses whose frames are degraded, evenly spread, int64."""
    observations = study.observations
    frames = max(_MOST_PIXELS // observations.distance_images[0].numel(), 1)
    count = int(np.clip(observations.num_units * frames / observations.num_frames, 1, None))
    count = min(count, observations.num_units)
    return torch.linspace(0, observations.num_units - 1, count).round().long()


def _folds(study: Study, chosen: Tensor) -> Iterator[Tensor]:
    """Yield which poses each fold holds out, bool, shape (U,); only chosen ones."""
    among = torch.zeros(study.observations.num_units, dtype=torch.bool)
    among[chosen] = True
    for members in study.folds:
        held = (members > 0) & among
        if bool(held.any()):
            yield held


def _without(study: Study, held: Tensor, names: Sequence[str]) -> Study:
    """Return a study whose sums of a model's effects, and whose maps, leave some poses out."""
    trust = study.fit.trust * (~held).double()[study.unit_of_pixel]
    return replace(fitted_to(study, ~held, names), fit=replace(study.fit, trust=trust))


def _expected(model: SensorModel, study: Study, named: NamedEffects, frames: Tensor) -> Tensor:
    """Return the expected radial distance of all pixels of some frames, (F, H W), metres."""
    observations = observed_by(study, named)
    light = light_images(model, study.observations, study.inputs)
    return expected_images(
        model,
        observations.recording,
        frames,
        distance_images(observations, solution_of(study, named)[0], frames),
        None if light is None else light[frames],
    ).flatten(1)
