"""The gap that a found sensor leaves: ideal frames, degraded, against poses it has never seen."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from torch import Tensor

from tofcorr.data.recording import Recording
from tofcorr.diagnosis.diagnose import diagnose
from tofcorr.diagnosis.findings.gap import TWO_SIDED
from tofcorr.diagnosis.options import DiagnosisOptions
from tofcorr.diagnosis.report.result import DiagnosisResult
from tofcorr.diagnosis.rerun.expected_images import expected_images, light_images
from tofcorr.diagnosis.rerun.fitted_simulator import solution_of
from tofcorr.diagnosis.rerun.found_sensor import sensor_of
from tofcorr.diagnosis.rerun.frames_gap import FramesGap, radial_at
from tofcorr.diagnosis.rerun.recording_parts import halves, subset, with_depth
from tofcorr.diagnosis.sums.noise import FLOOR_ERROR, brightness_of, estimate_noise
from tofcorr.diagnosis.sums.observations import Observations, distance_images, effect_inputs
from tofcorr.diagnosis.sums.observations import observe as observe_pixels
from tofcorr.errors import CalibrationDataError
from tofcorr.geometry.rays import ray_directions
from tofcorr.observables import measure_dropouts, measure_noise
from tofcorr.options import resolve_options
from tofcorr.sensor.degrade import degrade
from tofcorr.sensor.model import SensorModel
from tofcorr.sensor.sensor_file import SensorFile

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
            most**2 * _error_of_square(stage.after_interval),
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
        return DegradedGap(
            ideal=gap.of(depth),
            degraded=remains,
            degraded_interval=gap.interval(expected, seed),
            with_effects=found.gap.after,
            noise=(measure_noise(rest).temporal_m, measure_noise(degraded).temporal_m),
            dropouts=(measure_dropouts(rest).share, measure_dropouts(degraded).share),
            sensor=sensor,
            diagnosis=found,
            poses=observations.num_units,
            covered_share=float(covered.double().mean()),
        )


def _error_of_square(interval: tuple[float, float]) -> float:
    return (interval[1] ** 2 - interval[0] ** 2) / (2 * TWO_SIDED)


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
