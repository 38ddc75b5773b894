"""How well a correction trained on the simulator works on the real camera.

The correction that `tofcorr train` fits, with the terms of the base model, is fitted three times to
one half of the poses: to the simulator's frames, to those of the simulator with the named effects,
and to the recording. It is tested on the other half of the recording. Of that half nothing is used
before: the simulator's parameters, its effects with columns, and the hand-eye transform that the
corrected real images are judged by all come from the first half.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from tofcorr.correction.model import CalibrationModel
from tofcorr.diagnosis.findings.gap import Interval, interval_of
from tofcorr.diagnosis.findings.naming import NamedEffects
from tofcorr.diagnosis.rerun.chosen_pixels import recording_of
from tofcorr.diagnosis.rerun.excess import Excess
from tofcorr.diagnosis.rerun.fitted_simulator import observed_by, solution_of
from tofcorr.diagnosis.rerun.some_poses import fitted_to
from tofcorr.diagnosis.rerun.twin import fitted_distance, simulated_frames
from tofcorr.diagnosis.sums.observations import Observations, predicted_distance
from tofcorr.diagnosis.sums.study import Study
from tofcorr.fit.fitting import fit_hand_eye, fit_model
from tofcorr.fit.problem import FitOptions
from tofcorr.pixels.dataset import Dataset, HandEyeOptions
from tofcorr.pixels.domain import covered_domain
from tofcorr.simulation.options import SimulatorOptions

# Fewest frames of a half that a correction is trained on or tested on. Two fix a plane and a slope;
# fewer leave a half empty.
_LEAST_FRAMES = 2


@dataclass(frozen=True, kw_only=True)
class Transfer:
    """Root mean square errors on held-out real poses in excess of the noise, metres.

    Attributes:
        trained_on_sim: Of the correction trained on the simulator.
        trained_on_sim_with_effects: On the simulator with the named effects.
        trained_on_real: On real images.
        intervals: Of the three, 95 %, over the held-out poses; the trainings are not repeated.
        gain_interval: Of the first less the second, 95 %: what the effects save.
    """

    trained_on_sim: float
    trained_on_sim_with_effects: float
    trained_on_real: float
    intervals: tuple[Interval, Interval, Interval]
    gain_interval: Interval


def measure_transfer(
    study: Study,
    named: NamedEffects,
    given: SimulatorOptions | None,
    generator: torch.Generator,
    resamples: Tensor,
) -> Transfer | None:
    """Train on simulated and on real images; test on held-out real ones.

    Args:
        study: The recording.
        named: The effects named.
        given: The simulator under diagnosis; None: one made from the recording alone.
        generator: Of the split and the noise.
        resamples: How often each resample holds each pose, shape (B, U).

    Returns:
        None with too few poses to hold a half of them out.
    """
    observations = study.observations
    frames = np.array(simulated_frames(observations.recording))
    first_half = _half_of_the_poses(study, generator)
    of_frame = first_half[observations.unit[frames]].numpy()
    training, test = frames[of_frame], frames[~of_frame]
    if min(len(training), len(test)) < _LEAST_FRAMES:
        return None
    split = _Split(training, test, first_half)
    half = bare = replace(named, names=(), refined_terms=(), study=study)
    found, pose = [], study.fit.tool_from_camera
    noise = generator.get_state()
    for model in (bare, named) if named.adds_something else (bare,):
        generator.set_state(noise)  # The same for both: only the effects make a difference.
        half = replace(model, study=fitted_to(model.study, first_half, model.columns))
        distance = fitted_distance(half.study, half, given, generator, training.tolist())
        pose = solution_of(half.study, half)[0]
        found.append(_tested(study, observed_by(study, half), distance, pose, split))
    walls = observed_by(study, half)
    found.append(_tested(study, walls, observations.measured, pose, split))
    compared = found[0], found[-2], found[-1]
    on_sim, with_effects, on_real = (each.gap() for each in compared)
    draws = [each.gaps(resamples) for each in compared]
    sim, effects, real = (
        interval_of(drawn.tolist(), size)
        for drawn, size in zip(draws, (on_sim, with_effects, on_real), strict=True)
    )
    return Transfer(
        trained_on_sim=on_sim,
        trained_on_sim_with_effects=with_effects,
        trained_on_real=on_real,
        intervals=(sim, effects, real),
        gain_interval=interval_of((draws[0] - draws[1]).tolist(), on_sim - with_effects),
    )


def _half_of_the_poses(study: Study, generator: torch.Generator) -> Tensor:
    """Return which poses train, bool, shape (U,): one of every two that are next in distance.

    So both halves see the same distances; outside of those trained on, a correction extrapolates.
    """
    unit, share = study.unit_of_pixel, study.fit.share
    units = study.sums.num_units
    weights, sums = torch.zeros(2, units, dtype=torch.float64)
    weights = weights.index_add(0, unit, share)
    sums = sums.index_add(0, unit, share * study.observations.measured.nan_to_num(0.0))
    rank = (sums / weights).argsort().argsort()
    first_of_pair = torch.randint(2, (units // 2 + 1,), generator=generator)
    return rank % 2 == first_of_pair[rank // 2]


@dataclass(frozen=True)
class _Split:
    """Frames that train and that test, and the poses of the first."""

    training: np.ndarray
    test: np.ndarray
    units: Tensor


def _tested(
    study: Study, observations: Observations, distance: Tensor, pose: Tensor, split: _Split
) -> Excess:
    """Train a correction on distances (M,), and return its error on held-out real poses.

    Args:
        study: The recording.
        observations: Its pixels, with estimated walls where the model has them.
        distance: What the camera to train on measures in the chosen pixels; NaN: not used.
        pose: Its hand-eye transform, where the fit starts, shape (4, 4).
        split: Which frames train and test.
    """
    use = study.fit.trust > 0
    options = _options(study)
    images = recording_of(observations, torch.where(use, distance, torch.nan), pose)
    dataset = Dataset((images,))
    domain = covered_domain(dataset, split.training)
    trained = fit_model(dataset, split.training, options, domain)
    corrected = torch.where(use, observations.measured - _error(study, trained), torch.nan)
    seen_from = pose
    if study.fit.model.hand_eye_free:
        real = Dataset((recording_of(observations, corrected, pose),))
        seen_from = fit_hand_eye(real, split.training, options, domain).tool_from_camera
    left = corrected - predicted_distance(observations, seen_from)
    tested = torch.from_numpy(np.isin(observations.frame.numpy(), split.test))
    return Excess.of(study.observations, left, study.fit.share * tested, study.fit.sigma)


def _options(study: Study) -> FitOptions:
    estimate = "yes" if study.fit.model.hand_eye_free else "no"
    hand_eye = HandEyeOptions(estimate=estimate, start="recording")
    return FitOptions(model=study.fit.model.options, hand_eye=hand_eye)


def _error(study: Study, trained: CalibrationModel) -> Tensor:
    """Return the error that a correction predicts for the measured pixels, shape (M,), metres."""
    observations = study.observations
    shape = observations.distance_images.shape[1:]
    conditions = observations.conditions()
    error = torch.full_like(observations.measured, torch.nan)
    for frame, (start, end) in enumerate(observations.frame_ends):
        measured = torch.full((shape[0] * shape[1],), torch.nan, dtype=torch.float64)
        pixel = observations.pixel[start:end]
        measured[pixel] = observations.measured[start:end]
        amplitude = None
        if observations.amplitude_images is not None:
            amplitude = observations.amplitude_images[frame][None].double()
        with torch.no_grad():
            predicted = trained.error(
                measured.reshape(1, *shape), amplitude, conditions[frame][None]
            )
        error[start:end] = predicted.reshape(-1)[pixel]
    return error
