"""The findings put to the test: simulator run again, corrections trained on it, poses held out."""

import math
from dataclasses import dataclass, replace
from warnings import catch_warnings, simplefilter

import numpy as np
import torch
from torch import Tensor

from tofcorr.data.recording import Recording
from tofcorr.diagnosis.findings.where import Estimated
from tofcorr.diagnosis.rerun.simulator import Evidence, sensor_of, simulated_frames
from tofcorr.diagnosis.sums.observations import (
    TINY,
    Observations,
    distance_images,
    predicted_distance,
)
from tofcorr.diagnosis.sums.shared_noise import MOST_PIXELS
from tofcorr.diagnosis.sums.study import Study
from tofcorr.fit.fitting import fit
from tofcorr.fit.problem import FitOptions
from tofcorr.geometry.rays import ray_directions, z_depth_from_radial_distance
from tofcorr.pixels.dataset import Dataset, HandEyeOptions
from tofcorr.pixels.lattice import covered_domain
from tofcorr.pixels.sample import thinned
from tofcorr.sensor.degrade import conditions_of_frames
from tofcorr.sensor.model import Around, SensorModel, SensorWarning
from tofcorr.simulation.effects.multipath import MultipathEffect
from tofcorr.simulation.effects.saturation import light_of
from tofcorr.simulation.options import SimulatorOptions
from tofcorr.simulation.simulator import twin_frames


def excess_gaps(
    observations: Observations, left: Tensor, share: Tensor, noise: Tensor | float, drawn: Tensor
) -> Tensor:
    """Return the root mean square beyond the noise, of all poses and of resamples of them, metres.

    Args:
        observations: The M pixels.
        left: Measured less expected, shape (M,), metres; what is not finite does not count.
        share: Weights, shape (M,).
        noise: Standard deviation of the pixels, shape (M,) or one number, metres.
        drawn: How often each resample holds each pose, shape (B, U).

    Returns:
        Shape (1 + B,), all poses first; 0 where noise explains more.
    """
    share = share * left.isfinite()
    squares = share * (left.nan_to_num(0.0, 0.0, 0.0) ** 2 - noise**2)
    sums = torch.stack([observations.per_pose(values) for values in (squares, share)], dim=1)
    drawn = torch.cat([torch.ones(1, len(sums), dtype=torch.float64), drawn])
    square, weight = (drawn @ sums).unbind(dim=1)
    return (square / weight.clamp(min=TINY)).clamp(min=0.0).sqrt()


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
    pairs = ((one.measured_distance, one.measured_amplitude.nan_to_num(0.0)) for one in states)
    depth, amplitude = zip(*pairs, strict=True)
    return _in_memory(
        recording,
        torch.stack(depth),
        saturation_amplitude=None,
        frames=recording.frames.select(np.array(frames)),
        amplitude=torch.stack(amplitude).float().numpy(),
        mask=recording.read("mask", np.array(frames)),
    )


def _in_memory(recording: Recording, distance: Tensor, **changes: object) -> Recording:
    """Return a recording of other radial distances, shape (F, H, W), metres, and changed fields."""
    if recording.depth_kind == "z":
        distance = z_depth_from_radial_distance(distance, ray_directions(recording.camera))
    depth, whole = distance.float().numpy(), {"raw": None, "true_depth": None, "planes": "recorded"}
    return replace(recording, depth=depth, **whole, **changes)


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
    amplitude = observations.amplitude_images
    return _in_memory(
        recording,
        images,
        tool_from_camera=tool_from_camera.numpy(),
        amplitude=None if amplitude is None else amplitude.clamp(min=0.0).numpy(),
        mask=None,
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


def check_in_simulator(found: Evidence) -> Closure:
    """Run the simulator without and with the effects, and compare the recording with both."""
    study = found.study
    frames = simulated_frames(study.observations.recording)
    gaps, none = [], torch.zeros(0, study.sums.num_units, dtype=torch.float64)
    for model in _compared(found):
        left = study.observations.measured - _held_out(model, frames)
        share, sigma = study.fit.share, study.fit.sigma
        gaps.append(float(excess_gaps(study.observations, left, share, sigma, none)))
    return Closure(without_effects=gaps[0], with_effects=gaps[-1], frames=len(frames))


def _compared(found: Evidence) -> list[Evidence]:
    """Return the model without effects, and with them if they add something."""
    return [found.without_effects(), *([found] if found.named.names else [])]


def _held_out(found: Evidence, frames: list[int]) -> Tensor:
    """Return what the simulator measures, fitted without the poses it is run at, (M,), metres."""
    folds, unit = found.study.folds, found.study.observations.unit
    part = folds.argmax(0) * _PARTS // len(folds)
    distance = torch.full_like(found.study.observations.measured, torch.nan)
    for number in range(_PARTS):
        held_out = part == number
        own = [frame for frame in frames if bool(held_out[unit[frame]])]
        if own:
            measured = found.fitted_to(~held_out).distance(None, own)
            distance = torch.where(measured.isfinite(), measured, distance)
    return distance


@dataclass(frozen=True)
class Transfer:
    """Root mean square errors on held-out real poses in excess of the noise, metres.

    Intervals are over the held-out poses; the trainings are not repeated.

    Attributes:
        trained_on_sim: Of the correction trained on the simulator.
        trained_on_sim_with_effects: On the simulator with the named effects.
        trained_on_real: On real images.
        gain: The first less the second: what the effects save.
    """

    trained_on_sim: Estimated
    trained_on_sim_with_effects: Estimated
    trained_on_real: Estimated
    gain: Estimated


def measure_transfer(
    found: Evidence, generator: torch.Generator, resamples: Tensor
) -> Transfer | None:
    """Train on simulated and on real images; test on held-out real ones.

    Args:
        found: The simulator, and the recording.
        generator: Of the split and the noise.
        resamples: How often each resample holds each pose, shape (B, U).

    Returns:
        None with too few poses to hold a half of them out.
    """
    study = found.study
    frames = np.array(simulated_frames(study.observations.recording))
    first_half = _half_of_the_poses(study, generator)
    of_frame = first_half[study.observations.unit[frames]].numpy()
    split = frames[of_frame], frames[~of_frame]
    # Two fix a plane and a slope; fewer leave a half empty.
    if min(map(len, split)) < 2:
        return None
    gaps, half = [], found
    noise = generator.get_state()
    for model in _compared(found):
        generator.set_state(noise)  # The same for both: only the effects make a difference.
        half = model.fitted_to(first_half)
        simulated = half.distance(generator, split[0].tolist())
        gaps.append(_tested(study, half, simulated, split, resamples))
    real = _tested(study, half, study.observations.measured, split, resamples)
    return Transfer(*map(Estimated.of, (gaps[0], gaps[-1], real, gaps[0] - gaps[-1])))


def _half_of_the_poses(study: Study, generator: torch.Generator) -> Tensor:
    """Return which poses train, bool, shape (U,): one of every two that are next in distance.

    So both halves see the same distances; outside of those trained on, a correction extrapolates.
    """
    observations, share = study.observations, study.fit.share
    sums = observations.per_pose(share * observations.measured.nan_to_num(0.0))
    rank = (sums / observations.per_pose(share)).argsort().argsort()
    first_of_pair = torch.randint(2, (len(sums) // 2 + 1,), generator=generator)
    return rank % 2 == first_of_pair[rank // 2]


def _tested(
    study: Study,
    found: Evidence,
    distance: Tensor,
    split: tuple[np.ndarray, np.ndarray],
    resamples: Tensor,
) -> Tensor:
    """Train a correction on distances (M,), and return its error on held-out real poses.

    Args:
        study: The recording, with all its poses.
        found: The simulator, fitted to some of them, where the training starts.
        distance: What the camera to train on measures in the chosen pixels; NaN: not used.
        split: Which frames train, and which test.
        resamples: As of `excess_gaps`, and so is what is returned.
    """
    training, test = split
    observations, pose = found.observations, found.tool_from_camera
    free, use = study.fit.model.hand_eye_free, study.fit.trust > 0
    hand_eye = HandEyeOptions(estimate="yes" if free else "no", start="recording")
    options = FitOptions(model=study.fit.model.options, hand_eye=hand_eye)
    dataset = Dataset((recording_of(observations, torch.where(use, distance, torch.nan), pose),))
    domain = covered_domain(dataset, training)
    trained = fit(dataset, training, options, domain).model
    with torch.no_grad():
        error = trained.error.error_at(observations.term_inputs(observations.measured))
    corrected = torch.where(use, observations.measured - error, torch.nan)
    if free:
        real = Dataset((recording_of(observations, corrected, pose),))
        pose = fit(real, training, options, domain).hand_eye_only.tool_from_camera
    left = corrected - predicted_distance(observations, pose)
    tested = torch.from_numpy(np.isin(observations.frame.numpy(), test))
    weights = study.fit.share * tested
    return excess_gaps(observations, left, weights, study.fit.sigma, resamples)


def _expected_images(
    model: SensorModel, found: Evidence, frames: Tensor, light: Tensor | None
) -> Tensor:
    """Return the distances that a sensor is expected to measure of the plane, (F, H, W), metres.

    Off the target it sees what was measured.

    Args:
        model: The sensor.
        found: Poses and planes; and conditions of all frames, for effects of whole frames depend on
            those before.
        frames: Numbers of the F frames, int64.
        light: Light that returns in all frames, shape (N, H, W), counts; None: unknown.
    """
    known = conditions_of_frames(found.observations.recording)
    shift = model.frame_shift(found.observations.num_frames, **known)
    distance = distance_images(found.observations, found.tool_from_camera, frames)
    shapes = [effect.shape for effect in found.effects if isinstance(effect, MultipathEffect)]
    around = None
    if model.bounces is not None:
        poses = found.observations.facts.world_from_tool[frames] @ found.tool_from_camera
        around = Around(shapes[0].around(), poses)
    with torch.inference_mode():
        seen = model(
            distance / model.eye.radial_of_depth,
            None if light is None else light[frames].double(),
            noise=False,
            frame_shift=shift[frames],
            around=around,
            **{name: torch.as_tensor(values)[frames] for name, values in known.items()},
        )
    return seen.depth * model.eye.radial_of_depth


def _light_images(model: SensorModel, study: Study) -> Tensor | None:
    """Return the light that reached the camera, shape (F, H, W), counts; None: not recorded.

    It is the recorded amplitude. Where a sensor clips bright pixels, that of the chosen pixels is
    what it would have been without clipping, as in the fit.
    """
    observations, images = study.observations, study.observations.amplitude_images
    if images is None or not model.effects.reads_light:
        return images
    lit = images.double().flatten(1)
    lit[observations.frame, observations.pixel] = light_of(study.inputs)
    return lit.reshape(images.shape)


@dataclass(frozen=True, kw_only=True)
class DegradedStage:
    """Ideal frames through the sensor that was found, against real frames of other poses.

    Attributes:
        gap: Root mean square in excess of the noise, metres; its interval has poses as the unit,
            and the fit is not repeated.
        poses: How many poses were compared.
        left_out: Effects of the sensor that no depth image can show, and why, a sentence each.
    """

    gap: Estimated
    poses: int
    left_out: tuple[str, ...]


def degraded_stage(found: Evidence, floor: float, resamples: Tensor) -> DegradedStage:
    """Fit the sensor without each fold of the poses, and degrade ideal frames of that fold.

    The effects were chosen with all poses; hand-eye transform and coefficients are those of the
    other folds. Ideal frames show the target's plane, and off the target what was measured.

    Args:
        found: The final model.
        floor: Noise of a pixel, root mean square, metres, as in the other stages.
        resamples: How often each resample holds each pose, shape (B, U).
    """
    study = found.study
    observations = study.observations
    frames = max(MOST_PIXELS // observations.distance_images[0].numel(), 1)
    units = observations.num_units
    count = int(np.clip(units * frames / observations.num_frames, 1, units))
    among = torch.zeros(units, dtype=torch.bool)
    among[thinned(np.arange(units), count)] = True
    expected = torch.full_like(observations.measured, torch.nan)
    # Patches of half the usual number a side: a tenth of the time, and 2 % of the light.
    coarse = 4 * math.ceil(observations.recording.camera.width / 64)
    left_out: tuple[str, ...] = ()
    for held in filter(torch.any, ((members > 0) & among for members in study.folds)):
        own = found.fitted_to(~held)
        with catch_warnings():
            simplefilter("ignore", SensorWarning)  # `left_out` says so once, and not in each fold.
            model = SensorModel(sensor_of(own, None).ending_with_the_image(coarse), torch.float64)
            left_out = model.left_out
            frames_held = torch.nonzero(held[observations.unit]).reshape(-1)
            light = _light_images(model, study)
            images = _expected_images(model, own, frames_held, light).flatten(1)
        pixels = held[study.unit_of_pixel].nonzero().reshape(-1)
        place = torch.searchsorted(frames_held, observations.frame[pixels])
        expected[pixels] = images[place, observations.pixel[pixels]]
    left = observations.measured - expected
    gaps = excess_gaps(observations, left, study.fit.share, floor, resamples)
    return DegradedStage(gap=Estimated.of(gaps), poses=int(among.sum()), left_out=left_out)
