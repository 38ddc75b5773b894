"""How far a found sensor closes the gap: degraded ideal frames against real ones, held out.

    python -m benchmarks.degraded_gap RECORDING [--ideal IDEAL] [--config NAME] [--seeds 1 2 3]
    python -m benchmarks.degraded_gap --simulated 5 [--seeds 1]

Half of the poses are diagnosed; the sensor that this gives degrades ideal frames of the other half.
`--simulated N` does so for N cameras of the built-in simulator, each with D, P and I errors, dark
pixels missing, and one effect of a few millimetres. `<= 1.1`: degraded frames leave at most 1.1
times the stage with effects; `open`: more, but not significantly (one-sided, 5 %).
"""

import argparse
import math
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from torch import Tensor

from tofcorr.data.recording import Recording
from tofcorr.data.writing import RecordingWriter
from tofcorr.diagnosis.diagnose import diagnose
from tofcorr.diagnosis.findings.gap import resampled
from tofcorr.diagnosis.options import DiagnosisOptions
from tofcorr.diagnosis.report.result import DiagnosisResult
from tofcorr.diagnosis.rerun.checks import Excess
from tofcorr.diagnosis.rerun.sensor import expected_images, light_images, sensor_of
from tofcorr.diagnosis.rerun.simulator import solution_of
from tofcorr.diagnosis.sums.noise import (
    FLOOR_ERROR,
    brightness_of,
    common_of_neighbours,
    estimate_noise,
    gap_weight,
    robust_weights,
)
from tofcorr.diagnosis.sums.observations import Observations, distance_images, effect_inputs
from tofcorr.diagnosis.sums.observations import observe as observe_pixels
from tofcorr.errors import CalibrationDataError
from tofcorr.estimation.robust import student_quantile
from tofcorr.geometry.rays import radial_distance_from_z_depth, ray_directions
from tofcorr.observables.dropouts import dropouts_of
from tofcorr.observables.noise import noise_of
from tofcorr.observables.read import observe, pose_groups
from tofcorr.options import resolve_options
from tofcorr.sensor.degrade import degrade
from tofcorr.sensor.model import SensorModel
from tofcorr.sensor.sensor_file import SensorFile
from tofcorr.simulation.options import SimulatorOptions
from tofcorr.simulation.simulator import simulate

# What degraded frames may leave at most, times the gap of the stage with effects.
_MOST = 1.1

EFFECTS: tuple[dict[str, Any], ...] = (
    {"name": "wiggling", "sin_4": 0.012, "cos_4": 0.006},
    {"name": "integration_time", "log_1": -0.01},
    {"name": "incidence_angle", "square": 0.3},
    {"name": "ambient_light", "reference_counts": 200.0, "linear": 0.008},
    {"name": "mixed_pixels", "share_1.2px": 0.8},
)


def simulated(number: int, seed: int, out: Path) -> Recording:
    """Simulate a camera with one effect."""
    options = resolve_options(SimulatorOptions, "diagnosis").to_mapping()
    options["shots"] = [{"target": "white", "poses": 30}, {"target": "checkerboard", "poses": 50}]
    # The converter never saturates; pixels darker than this have no distance.
    readout = options["sensor"]["readout"] | {
        "converter_bits": 24,
        "least_amplitude_counts": 1500.0,
    }
    options["sensor"]["readout"] = readout
    options["effects"] = [EFFECTS[number % len(EFFECTS)]]
    return simulate(options | {"seed": 1000 * seed + number}, out)


def halves(recording: Recording, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the frames of a random half of the poses, and those of the other half."""
    groups = pose_groups(recording)
    order = np.random.default_rng(seed).permutation(len(groups))
    parts = order[: (len(groups) + 1) // 2], order[(len(groups) + 1) // 2 :]
    first, second = (np.sort(np.concatenate([groups[k] for k in part])) for part in parts)
    return first, second


def subset(recording: Recording, frames: np.ndarray, path: Path) -> Recording:
    """Write some frames of a recording as a recording of their own."""
    with RecordingWriter.with_header_of(path, recording) as writer:
        for number in frames.tolist():
            images = _images(recording, number)
            writer.append(images.pop("depth"), row=recording.frames.row(number), **images)
    return Recording.open(path, check_contents=False)


def with_depth(recording: Recording, depth: Tensor, path: Path) -> Recording:
    """Write a recording anew with other depth (F, H, W)."""
    with RecordingWriter.with_header_of(path, recording) as writer:
        for number, image in enumerate(depth.numpy()):
            images = _images(recording, number) | {"depth": image}
            writer.append(images.pop("depth"), row=recording.frames.row(number), **images)
    return Recording.open(path, check_contents=False)


def _images(recording: Recording, number: int) -> dict[str, Any]:
    names = ("depth", "amplitude", "mask")
    read = {name: recording.read(name, np.array([number])) for name in names}
    return {name: None if image is None else image[0] for name, image in read.items()}


# Resamples of the poses behind an interval. The usual number for 95 %.
_RESAMPLES = 400


class FramesGap:
    """Root mean square of measured minus simulated distances, less the noise."""

    def __init__(
        self, observations: Observations, sigma: Tensor, floor_factor: float, counted: Tensor
    ) -> None:
        self._observations = observations
        self._counted = counted
        self._sigma = sigma
        self._floor_factor = floor_factor

    def of(self, depth: Tensor) -> float:
        """Return the gap to depth images (F, H, W) of the recording's kind, metres."""
        return self._excess(depth).gap()

    def interval(self, depth: Tensor, seed: int) -> tuple[float, float]:
        """Return the 95 % interval of the gap: poses are drawn anew."""
        generator = torch.Generator().manual_seed(seed)
        resamples = resampled(self._observations.num_units, _RESAMPLES, generator)
        gaps = self._excess(depth).gaps(resamples)
        low, high = gaps.quantile(torch.tensor([0.025, 0.975], dtype=gaps.dtype)).tolist()
        return low, high

    def _excess(self, depth: Tensor) -> Excess:
        observations, sigma = self._observations, self._sigma
        simulated = radial_at(observations, depth)
        known = simulated.isfinite() & (simulated > 0) & self._counted
        residual = torch.where(known, observations.measured - simulated, 0.0)
        trust = robust_weights(residual, sigma, common_of_neighbours(observations, residual))
        share = trust * gap_weight(sigma) * known
        return Excess.of(observations, residual, share, self._floor_factor * sigma)


def radial_at(observations: Observations, depth: Tensor) -> Tensor:
    """Return the distances of the chosen pixels in depth images (F, H, W), (M,), metres."""
    recording = observations.recording
    if recording.depth_kind == "z":
        depth = radial_distance_from_z_depth(depth, ray_directions(recording.camera))
    return depth.reshape(len(depth), -1)[observations.frame, observations.pixel].double()


# Quantile of the normal distribution of a one-sided test at 5 %, standard errors. Derived.
_ONE_SIDED = 1.645


@dataclass(frozen=True, kw_only=True)
class DegradedGap:
    """Real against ideal and degraded frames, at poses held out from everything; metres.

    Attributes:
        ideal: Gap of the ideal frames: root mean square of real minus ideal, less the noise.
        degraded: The same of the degraded frames: what remains.
        degraded_interval: Its 95 % interval, with poses as the unit.
        with_effects: The gap with effects that the diagnosis of the other poses states.
        noise: Standard deviation of the temporal noise: real, degraded.
        dropouts: Share of missing pixels on the target: real, degraded.
        sensor: What was found at the other poses.
        diagnosis: Of those poses.
        poses: Number of poses held out.
        covered_share: Share of their pixels within the distances and amplitudes of the other
            poses. Gaps are of these: beyond, the sensor is not measured.
    """

    ideal: float
    degraded: float
    degraded_interval: tuple[float, float]
    with_effects: float
    noise: tuple[float, float]
    dropouts: tuple[float, float]
    sensor: SensorFile
    diagnosis: DiagnosisResult
    poses: int
    covered_share: float

    def within(self, most: float) -> bool | None:
        """Return whether what remains is at most so many times what the stage states.

        Squares are compared, for these have normal errors: those of the poses on either side, and
        5 % of the noise floor in each half.

        Args:
            most: The factor.

        Returns:
            None: it is more, but by less than the data resolve (one-sided, 5 %).
        """
        stage, floor = self.diagnosis.gap, self.diagnosis.gap.floor
        excess = self.degraded**2 - (most * self.with_effects) ** 2
        errors = (
            _error_of_square(self.degraded_interval),
            most**2 * _error_of_square(stage.after.interval),
            2 * FLOOR_ERROR * floor**2,
            2 * FLOOR_ERROR * (most * floor) ** 2,
        )
        if excess <= 0:
            return True
        return None if excess <= _ONE_SIDED * math.hypot(*errors) else False

    @property
    def ratio(self) -> float:
        """What remains, over what the stage with effects states; 1: it holds at new poses."""
        return self.degraded / max(self.with_effects, 1e-9)


def degraded_gap(
    real: Recording,
    config: DiagnosisOptions | Mapping[str, Any] | Path | str | None = None,
    *,
    ideal: Recording | None = None,
    seed: int = 0,
) -> DegradedGap:
    """Diagnose half of the poses, degrade ideal frames of the other half, and compare.

    Args:
        real: The real recording.
        config: Options of the diagnosis; None: the defaults.
        ideal: Ideal frames at all poses of `real`, in its order; None: the planes of `real`, seen
            with the hand-eye transform that the diagnosed half gives.
        seed: Of the halves and of all draws.

    Raises:
        CalibrationDataError: `ideal` has other frames, or half of the poses is too few.
    """
    options = DiagnosisOptions() if config is None else resolve_options(DiagnosisOptions, config)
    options = options.model_copy(update={"simulate_anew": False, "page": False})
    if ideal is not None and ideal.num_frames != real.num_frames:
        raise CalibrationDataError(
            f"{ideal.path}: has {ideal.num_frames} frames, {real.path} has {real.num_frames}; "
            "expected one ideal frame for each real one."
        )
    shown, held = halves(real, seed)
    with TemporaryDirectory() as folder:
        scratch = Path(folder)
        diagnosed = subset(real, shown, scratch / "shown")
        found = diagnose(diagnosed, None, options)
        rest = subset(real, held, scratch / "held")
        observations = observe_pixels(rest, options.most_pixels)
        study, named = found.evidence.study, found.evidence.named
        pose = solution_of(study, named)[0]
        depth = _ideal_depth(observations, pose) if ideal is None else _read(ideal, held)
        mounted = replace(rest, tool_from_camera=pose.numpy()) if ideal is None else rest
        perfect = with_depth(mounted, depth, scratch / "ideal")
        sensor = sensor_of(study, named, found.simulator, found.observables)
        model = SensorModel(sensor)
        degraded = degrade(model, perfect, scratch / "degraded", seed=seed).recording
        expected = _expected(model, real, observations, depth, pose, held)
        noise = estimate_noise(observations, pose)
        sigma = noise.at(brightness_of(observations), observations.frame)
        factor = found.gap.floor / study.fit.floor
        covered = _covered(model, observations, depth)
        gap = FramesGap(observations, sigma, factor, covered)
        remains = gap.of(expected)
        both = [observe(each) for each in (rest, degraded)]
        return DegradedGap(
            ideal=gap.of(depth),
            degraded=remains,
            degraded_interval=gap.interval(expected, seed),
            with_effects=found.gap.after,
            noise=(noise_of(both[0]).temporal_m, noise_of(both[1]).temporal_m),
            dropouts=(dropouts_of(both[0]).share, dropouts_of(both[1]).share),
            sensor=sensor,
            diagnosis=found,
            poses=observations.num_units,
            covered_share=float(covered.double().mean()),
        )


def _error_of_square(interval: tuple[float, float]) -> float:
    return (interval[1] ** 2 - interval[0] ** 2) / (2 * student_quantile(0.975, math.inf))


def _read(recording: Recording, frames: np.ndarray) -> Tensor:
    source = "depth" if recording.true_depth is None else "true_depth"
    depth = recording.read(source, frames)
    assert depth is not None
    return torch.from_numpy(depth)


def _ideal_depth(observations: Observations, tool_from_camera: Tensor) -> Tensor:
    """Return what an ideal camera would have measured, (F, H, W), float32.

    On the target that is the plane; off it only the real camera knows what is there.
    """
    radial = distance_images(observations, tool_from_camera, slice(None))
    if observations.recording.depth_kind == "z":
        radial = radial * ray_directions(observations.recording.camera)[..., 2]
    return radial.float()


def _expected(
    model: SensorModel,
    real: Recording,
    observations: Observations,
    depth: Tensor,
    tool_from_camera: Tensor,
    held: np.ndarray,
) -> Tensor:
    """Return the expected measurement of ideal frames, shape (F, H, W), of the recording's kind."""
    inputs = effect_inputs(observations, tool_from_camera)
    slant = ray_directions(real.camera)[..., 2] if real.depth_kind == "z" else torch.ones(1)
    radial = expected_images(
        model,
        real,
        torch.from_numpy(held),
        depth / slant,
        light_images(model, observations, inputs),
    )
    return radial * slant


def _covered(model: SensorModel, observations: Observations, depth: Tensor) -> Tensor:
    """Return which chosen pixels are within the ranges that a sensor was measured in, (M,)."""
    return model.base.covers(radial_at(observations, depth), observations.amplitude)


def line(name: str, found: DegradedGap) -> str:
    """Return a row of the table."""
    within = {True: "yes", None: "open", False: "no"}[found.within(_MOST)]
    low, high = (1e3 * end for end in found.degraded_interval)
    return (
        f"{name:>22} {found.poses:5d} {1e3 * found.ideal:7.2f} {1e3 * found.with_effects:8.2f} "
        f"{1e3 * found.degraded:9.2f} [{low:5.2f}, {high:5.2f}] {within:>6} "
        f"{1e3 * found.noise[0]:7.2f} {1e3 * found.noise[1]:7.2f} "
        f"{found.dropouts[0]:8.4f} {found.dropouts[1]:8.4f} {found.covered_share:8.3f}  "
        f"{', '.join(found.diagnosis.effects)}"
    )


def main() -> None:
    """Print one row for every recording and seed."""
    parser = argparse.ArgumentParser(description="How far a found sensor closes the gap.")
    parser.add_argument("recording", nargs="?", type=Path)
    parser.add_argument("--ideal", type=Path)
    parser.add_argument("--config", default="default")
    parser.add_argument("--simulated", type=int, default=0)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1])
    given = parser.parse_args()
    print(
        f"{'camera':>22} poses   ideal  effects  degraded  95 % interval  <= 1.1    noise, mm      "
        "missing pixels  covered  named\n"
        f"{'':>22}  held      mm       mm        mm                            real degr.     "
        "real     degr."
    )
    ideal = None if given.ideal is None else Recording.open(given.ideal)
    for seed in given.seeds:
        if given.recording is not None:
            real = Recording.open(given.recording)
            found = degraded_gap(real, given.config, ideal=ideal, seed=seed)
            print(line(f"{given.recording.name}, seed {seed}", found), flush=True)
        for number in range(given.simulated):
            with tempfile.TemporaryDirectory() as folder:
                real = simulated(number, seed, Path(folder) / "real")
                found = degraded_gap(real, given.config, seed=seed)
            name = str(EFFECTS[number % len(EFFECTS)]["name"])
            print(line(f"{name}, seed {seed}", found), flush=True)


if __name__ == "__main__":
    main()
