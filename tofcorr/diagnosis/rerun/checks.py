"""The findings put to the test: simulator run again, corrections trained on it, poses held out."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from tofcorr.correction.model import CalibrationModel
from tofcorr.data.recording import Recording
from tofcorr.data.table import FrameRow
from tofcorr.data.writing import RecordingWriter
from tofcorr.diagnosis.findings.naming import NamedEffects
from tofcorr.diagnosis.findings.where import Interval, interval_of
from tofcorr.diagnosis.rerun.simulator import (
    fitted_distance,
    observed_by,
    simulated_frames,
    solution_of,
)
from tofcorr.diagnosis.sums.observations import Observations, predicted_distance
from tofcorr.diagnosis.sums.study import Study
from tofcorr.files import scratch_folder
from tofcorr.fit.fitting import fit_hand_eye, fit_model
from tofcorr.fit.problem import FitOptions
from tofcorr.geometry.rays import ray_directions, z_depth_from_radial_distance
from tofcorr.observables.compare import Observables, compare_observables
from tofcorr.pixels.dataset import Dataset, HandEyeOptions, covered_domain
from tofcorr.simulation.options import SimulatorOptions
from tofcorr.simulation.simulator import Reflectivity, twin_frames


def fitted_to(study: Study, units: Tensor, names: Sequence[str]) -> Study:
    """Return the study with ordinary sums of some poses alone, of which coefficients are fitted.

    Args:
        study: The recording.
        units: Which poses, shape (U,), bool.
        names: Effects with columns that the model has; the sums of all others are left out.
    """
    sums = study.sums.of(names)
    sums = replace(sums, plain=sums.plain * units.double()[:, None, None])
    return replace(study, system=replace(study.system, sums=sums))


@dataclass(frozen=True, kw_only=True)
class Excess:
    """What the gap of any resample of the poses is computed from.

    Attributes:
        squares: Sum of a pose's weighted squares less those of the noise, shape (U,), m^2.
        weight: Sum of its weights, shape (U,).
    """

    squares: Tensor
    weight: Tensor

    @classmethod
    def of(
        cls, observations: Observations, left: Tensor, share: Tensor, noise: Tensor | float
    ) -> "Excess":
        """Sum up over the poses.

        Args:
            observations: The M pixels.
            left: Measured less expected, shape (M,), metres; what is not finite does not count.
            share: Weights, shape (M,).
            noise: Standard deviation of the pixels, shape (M,) or one number, metres.
        """
        share = share * left.isfinite()
        unit = observations.unit[observations.frame]
        none = torch.zeros(observations.num_units, dtype=torch.float64)
        squares = share * (left.nan_to_num(0.0, 0.0, 0.0) ** 2 - noise**2)
        return cls(squares=none.index_add(0, unit, squares), weight=none.index_add(0, unit, share))

    def gap(self) -> float:
        """Return the root mean square of all poses, metres; 0 where noise explains more."""
        return float(self.gaps(torch.ones_like(self.weight)[None]))

    def gaps(self, resamples: Tensor) -> Tensor:
        """Return the same of resamples, shape (B,), metres.

        Args:
            resamples: How often each resample holds each pose, shape (B, U).
        """
        mean = (resamples @ self.squares) / (resamples @ self.weight).clamp(min=1e-30)
        return mean.clamp(min=0.0).sqrt()


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
    if sim is None or isinstance(sim, Recording):
        return compare_observables(recording, sim, seed=seed, level=level)
    with scratch_folder() as folder:
        frames = noisy_frames(recording, sim, seed, folder / "frames")
        return compare_observables(recording, frames, seed=seed, level=level)


def noisy_frames(
    recording: Recording, simulator: SimulatorOptions, seed: int, folder: Path
) -> Recording:
    """Run the built-in simulator with noise at the poses of a recording, and write its frames.

    The targets are those of the simulator's scene. Where the scene lacks a target, reflectivities
    come from the recorded amplitudes instead.

    Args:
        recording: Poses, planes, targets, conditions and masks.
        simulator: What to run.
        seed: Of the noise.
        folder: The folder to write; it must not exist yet.
    """
    camera = recording.camera
    frames = simulated_frames(recording)
    named = set(recording.frames.target.tolist()) <= simulator.scene.targets.keys()
    source: Reflectivity = "from_recording"
    if named or recording.amplitude is None:
        source = "pattern"
    states = twin_frames(
        simulator,
        recording,
        torch.Generator().manual_seed(seed),
        reflectivity=source,
        indices=frames,
    )
    with RecordingWriter(
        folder,
        camera=camera,
        depth_kind=recording.depth_kind,
        modulation_frequency=recording.modulation_frequency,
        tool_from_camera=recording.tool_from_camera,
    ) as writer:
        for frame, state in zip(frames, states, strict=True):
            depth = state.measured_distance
            if recording.depth_kind == "z":
                depth = z_depth_from_radial_distance(depth, ray_directions(camera))
            mask = recording.read("mask", np.array([frame]))
            row: FrameRow = recording.frames.row(frame)
            writer.append(
                depth.numpy(),
                row=row,
                amplitude=state.measured_amplitude.nan_to_num(0.0).numpy(),
                mask=None if mask is None else mask[0],
            )
    return Recording.open(folder, check_contents=False)


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
        Excess.of(
            study.observations,
            measured - _held_out(study, model, given, frames),
            study.fit.share,
            study.fit.sigma,
        ).gap()
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
        found.append(_tested(study, observed_by(study, half), distance, pose, split))
    walls = observed_by(study, half)
    found.append(_tested(study, walls, observations.measured, pose, split))
    compared = found[0], found[-2], found[-1]
    sizes, draws = [each.gap() for each in compared], [each.gaps(resamples) for each in compared]
    sim, effects, real = map(interval_of, (drawn.tolist() for drawn in draws), sizes)
    return Transfer(
        trained_on_sim=sizes[0],
        trained_on_sim_with_effects=sizes[1],
        trained_on_real=sizes[2],
        intervals=(sim, effects, real),
        gain_interval=interval_of((draws[0] - draws[1]).tolist(), sizes[0] - sizes[1]),
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
) -> Excess:
    """Train a correction on distances (M,), and return its error on held-out real poses.

    Args:
        study: The recording.
        observations: Its pixels, with estimated walls where the model has them.
        distance: What the camera to train on measures in the chosen pixels; NaN: not used.
        pose: Its hand-eye transform, where the fit starts, shape (4, 4).
        split: Which frames train, and which test.
    """
    training, test = split
    use, free = study.fit.trust > 0, study.fit.model.hand_eye_free
    hand_eye = HandEyeOptions(estimate="yes" if free else "no", start="recording")
    options = FitOptions(model=study.fit.model.options, hand_eye=hand_eye)
    images = recording_of(observations, torch.where(use, distance, torch.nan), pose)
    dataset = Dataset((images,))
    domain = covered_domain(dataset, training)
    trained = fit_model(dataset, training, options, domain)
    corrected = torch.where(use, observations.measured - _error(study, trained), torch.nan)
    if free:
        real = Dataset((recording_of(observations, corrected, pose),))
        pose = fit_hand_eye(real, training, options, domain).tool_from_camera
    left = corrected - predicted_distance(observations, pose)
    tested = torch.from_numpy(np.isin(observations.frame.numpy(), test))
    return Excess.of(study.observations, left, study.fit.share * tested, study.fit.sigma)


def _error(study: Study, trained: CalibrationModel) -> Tensor:
    """Return the error that a correction predicts for the measured pixels, shape (M,), metres."""
    observations = study.observations
    shape = observations.distance_images.shape[1:]
    conditions = observations.conditions
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
