"""The findings put to the test: simulator run again, corrections trained on it, poses held out."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from tofcorr.data.recording import Recording
from tofcorr.diagnosis.findings.naming import NamedEffects
from tofcorr.diagnosis.findings.where import Interval, interval_of
from tofcorr.diagnosis.rerun.simulator import (
    fitted_distance,
    observed_by,
    simulated_frames,
    solution_of,
)
from tofcorr.diagnosis.sums.observations import TINY, Observations, predicted_distance
from tofcorr.diagnosis.sums.study import Study
from tofcorr.error_terms.model import Pixels
from tofcorr.fit.fitting import fit
from tofcorr.fit.problem import FitOptions
from tofcorr.geometry.rays import ray_directions, z_depth_from_radial_distance
from tofcorr.observables.compare import Observables, compare_observables
from tofcorr.pixels.dataset import Dataset, HandEyeOptions, covered_domain
from tofcorr.simulation.options import SimulatorOptions
from tofcorr.simulation.simulator import twin_frames


def fitted_to(study: Study, units: Tensor, names: Sequence[str]) -> Study:
    """Return the study with ordinary sums, and maps, of some poses alone.

    Args:
        study: The recording.
        units: Which poses, shape (U,), bool.
        names: Effects with columns that the model has; the sums of all others are left out.
    """
    used = units.double()
    sums = study.sums.of(names)
    sums = replace(sums, plain=sums.plain * used[:, None, None])
    fit = replace(study.fit, trust=study.fit.trust * used[study.unit_of_pixel])
    return replace(study, system=replace(study.system, sums=sums), fit=fit)


def excess_gaps(
    observations: Observations,
    left: Tensor,
    share: Tensor,
    noise: Tensor | float,
    resamples: Tensor | None = None,
) -> Tensor:
    """Return the root mean square beyond the noise, of all poses and of resamples of them, metres.

    Args:
        observations: The M pixels.
        left: Measured less expected, shape (M,), metres; what is not finite does not count.
        share: Weights, shape (M,).
        noise: Standard deviation of the pixels, shape (M,) or one number, metres.
        resamples: How often each resample holds each pose, shape (B, U); None: there are none.

    Returns:
        Shape (1 + B,), all poses first; 0 where noise explains more.
    """
    share = share * left.isfinite()
    squares = share * (left.nan_to_num(0.0, 0.0, 0.0) ** 2 - noise**2)
    poses = observations.unit[observations.frame]
    sums = torch.zeros(observations.num_units, 2, dtype=torch.float64)
    sums.index_add_(0, poses, torch.stack([squares, share], dim=1))
    drawn = torch.ones(1, len(sums), dtype=torch.float64)
    if resamples is not None:
        drawn = torch.cat([drawn, resamples])
    square, weight = (drawn @ sums).unbind(dim=1)
    return (square / weight.clamp(min=TINY)).clamp(min=0.0).sqrt()


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
    if isinstance(sim, SimulatorOptions):
        sim = noisy_frames(recording, sim, seed)
    return compare_observables(recording, sim, seed=seed, level=level)


def noisy_frames(recording: Recording, simulator: SimulatorOptions, seed: int) -> Recording:
    """Run the built-in simulator with noise at the poses of a recording; return it in memory.

    The targets are those of the simulator's scene. Where the scene lacks a target, reflectivities
    come from the recorded amplitudes instead.

    Args:
        recording: Poses, planes, targets, conditions and masks.
        simulator: What to run.
        seed: Of the noise.
    """
    frames = simulated_frames(recording)
    named = set(recording.frames.target.tolist()) <= simulator.scene.targets.keys()
    states = twin_frames(
        simulator,
        recording,
        torch.Generator().manual_seed(seed),
        reflectivity="pattern" if named or recording.amplitude is None else "from_recording",
        indices=frames,
    )
    depth, amplitude = zip(
        *((one.measured_distance, one.measured_amplitude.nan_to_num(0.0)) for one in states),
        strict=True,
    )
    depth = torch.stack(depth)
    if recording.depth_kind == "z":
        depth = z_depth_from_radial_distance(depth, ray_directions(recording.camera))
    return replace(
        recording,
        saturation_amplitude=None,
        frames=recording.frames.select(np.array(frames)),
        depth=depth.float().numpy(),
        amplitude=torch.stack(amplitude).float().numpy(),
        mask=recording.read("mask", np.array(frames)),
        raw=None,
        true_depth=None,
        planes="recorded",
    )


def recording_of(
    observations: Observations, distance: Tensor, tool_from_camera: Tensor
) -> Recording:
    """Return a recording in memory in which only the chosen pixels have a distance.

    Args:
        observations: Frames, pixels, planes and amplitudes.
        distance: Radial distance of each chosen pixel, shape (M,), metres; NaN: none.
        tool_from_camera: Hand-eye transform that its header states, shape (4, 4).
    """
    recording = observations.recording
    images = torch.full(observations.distance_images.shape, torch.nan, dtype=torch.float64)
    images.flatten(1)[observations.frame, observations.pixel] = distance
    depth = images.numpy()
    if recording.depth_kind == "z":
        depth = depth * ray_directions(recording.camera)[..., 2].numpy()
    amplitude = observations.amplitude_images
    return replace(
        recording,
        tool_from_camera=tool_from_camera.numpy(),
        frames=replace(
            recording.frames,
            normal_world=observations.facts.normal_world.numpy(),
            offset=observations.facts.offset.numpy(),
        ),
        depth=depth.astype(np.float32),
        amplitude=None if amplitude is None else amplitude.clamp(min=0.0).numpy(),
        mask=None,
        raw=None,
        true_depth=None,
        planes="recorded",
    )


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
    models = (bare, named) if named.adds_something else (bare,)
    gaps = [
        float(
            excess_gaps(
                study.observations,
                measured - _held_out(study, model, given, frames),
                study.fit.share,
                study.fit.sigma,
            )
        )
        for model in models
    ]
    return Closure(without_effects=gaps[0], with_effects=gaps[-1], frames=len(frames))


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
    split = frames[of_frame], frames[~of_frame]
    # Two fix a plane and a slope; fewer leave a half empty.
    if min(map(len, split)) < 2:
        return None
    half = bare = replace(named, names=(), refined_terms=(), study=study)
    found, pose = [], study.fit.tool_from_camera
    noise = generator.get_state()
    for model in (bare, named) if named.adds_something else (bare,):
        generator.set_state(noise)  # The same for both: only the effects make a difference.
        half = replace(model, study=fitted_to(model.study, first_half, model.columns))
        distance = fitted_distance(half.study, half, given, generator, split[0].tolist())
        pose = solution_of(half.study, half)[0]
        walls = observed_by(study, half)
        found.append(_tested(study, walls, distance, pose, split, resamples))
    walls = observed_by(study, half)
    real = _tested(study, walls, observations.measured, pose, split, resamples)
    compared = found[0], found[-1], real, found[0] - found[-1]
    intervals = [interval_of(gaps[1:].tolist(), float(gaps[0])) for gaps in compared]
    return Transfer(
        trained_on_sim=float(found[0][0]),
        trained_on_sim_with_effects=float(found[-1][0]),
        trained_on_real=float(real[0]),
        intervals=(intervals[0], intervals[1], intervals[2]),
        gain_interval=intervals[3],
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


def _tested(
    study: Study,
    observations: Observations,
    distance: Tensor,
    pose: Tensor,
    split: tuple[np.ndarray, np.ndarray],
    resamples: Tensor,
) -> Tensor:
    """Train a correction on distances (M,), and return its error on held-out real poses.

    Args:
        study: The recording.
        observations: Its pixels, with estimated walls where the model has them.
        distance: What the camera to train on measures in the chosen pixels; NaN: not used.
        pose: Its hand-eye transform, where the fit starts, shape (4, 4).
        split: Which frames train, and which test.
        resamples: As of `excess_gaps`, and so is what is returned.
    """
    training, test = split
    use, free = study.fit.trust > 0, study.fit.model.hand_eye_free
    hand_eye = HandEyeOptions(estimate="yes" if free else "no", start="recording")
    options = FitOptions(model=study.fit.model.options, hand_eye=hand_eye)
    dataset = Dataset((recording_of(observations, torch.where(use, distance, torch.nan), pose),))
    domain = covered_domain(dataset, training)
    trained = fit(dataset, training, options, domain).model
    measured, width = observations.measured, observations.distance_images.shape[2]
    pixels = Pixels(
        measured,
        measured if observations.amplitude is None else observations.amplitude,
        (observations.pixel // width).double(),
        (observations.pixel % width).double(),
        observations.conditions[observations.frame],
    )
    with torch.no_grad():
        corrected = torch.where(use, measured - trained.error.error_at(pixels), torch.nan)
    if free:
        real = Dataset((recording_of(observations, corrected, pose),))
        pose = fit(real, training, options, domain).hand_eye_only.tool_from_camera
    left = corrected - predicted_distance(observations, pose)
    tested = torch.from_numpy(np.isin(observations.frame.numpy(), test))
    weights = study.fit.share * tested
    return excess_gaps(study.observations, left, weights, study.fit.sigma, resamples)
