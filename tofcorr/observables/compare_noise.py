"""Compares the noise of a recording with that of a simulated one."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from tofcorr.observables.matched import Matched
from tofcorr.observables.noise import NoiseMeasurement
from tofcorr.observables.pose_tests import Interval, permutation_p, sign_flip_p

# A simulator with less noise counts as free of it, metres. Chosen: rounding of float32 depth up to
# 10 m is 0.5 um.
_NO_NOISE = 1e-6
# Smallest deviation of the ratio from one, and of the correlation, that is reported. Chosen: what
# trains a network on simulated depth does not notice less.
_MATERIAL_RATIO = 0.05
_MATERIAL_CORRELATION = 0.05

_CAUSES = ("noise floor", "shot noise", "read noise")
_FILTER = "edge-preserving filter of the camera"
_TIME_FILTER = "filter of the camera in time"


@dataclass(frozen=True, kw_only=True, eq=False)
class NoiseComparison:
    """The temporal noise of both; standard deviations in metres.

    Attributes:
        real: Measurement of the recording.
        sim: Measurement of the simulated one, from the same source.
        real_m: Of the recording, over the pixels compared.
        sim_m: Of the simulated one there.
        ratio: Of both; None: the simulator has no noise.
        ratio_interval: Its 95 % interval; None: fewer than six poses, or no noise.
        p_value: Of equal noise; None: fewer than six poses.
        correlation_p: P-value of equal correlation of nearest neighbours; None: unknown.
        frames_p: P-value of equal correlation of successive frames; None: unknown.
        paired: Whether both show the same poses.
        explained_by: What of the camera the simulator lacks or exaggerates, the largest first;
            empty where nothing is significant and material.
    """

    real: NoiseMeasurement
    sim: NoiseMeasurement
    real_m: float
    sim_m: float
    ratio: float | None
    ratio_interval: Interval | None
    p_value: float | None
    correlation_p: float | None
    frames_p: float | None
    paired: bool
    explained_by: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """Return the block `noise` of diagnosis.json, lengths in millimetres."""
        return {
            "real_mm": _mm(self.real_m),
            "sim_mm": _mm(self.sim_m),
            "ratio": None if self.ratio is None else round(self.ratio, 4),
            "ratio_ci": _rounded(self.ratio_interval),
            "p_value": self.p_value,
            "correlation_p_value": self.correlation_p,
            "frame_correlation_p_value": self.frames_p,
            "source": self.real.source,
            "same_poses": self.paired,
            "real": _parts(self.real),
            "sim": _parts(self.sim),
            "explained_by": list(self.explained_by),
        }


def compare_noise(
    both: Matched,
    real: NoiseMeasurement,
    sim: NoiseMeasurement,
    random: np.random.Generator,
    level: float,
) -> NoiseComparison:
    """Compare the temporal noise.

    Args:
        both: The pixels to compare.
        real: Measurement of the recording.
        sim: Measurement of the simulated one, from the same source.
        random: Of resamples and permutations.
        level: Significance level.
    """
    sums = both.sums(
        real.variance[both.rows],
        sim.variance[both.columns],
        left_out=(real.left_out, sim.left_out),
    )
    means = [max(mean, 0.0) ** 0.5 for mean in np.nan_to_num(sums.means()).tolist()]
    ratio = interval = None
    if means[1] > _NO_NOISE:
        ratio = means[0] / means[1]
        squares = sums.ratio_interval()
        if squares is not None:
            interval = (max(squares[0], 0.0) ** 0.5, max(squares[1], 0.0) ** 0.5)
        p_value = sums.ratio_p(random)
    else:
        p_value = sums.difference_p(random)
    correlation_p = frames_p = None
    if ratio is not None:
        near = real.pose_correlation, sim.pose_correlation
        correlation_p = _correlation_p(both, *near, random)
        later = real.pose_frame_correlation, sim.pose_frame_correlation
        frames_p = _correlation_p(both, *later, random)
    found = NoiseComparison(
        real=real,
        sim=sim,
        real_m=means[0],
        sim_m=means[1],
        ratio=ratio,
        ratio_interval=interval,
        p_value=p_value,
        correlation_p=correlation_p,
        frames_p=frames_p,
        paired=both.paired,
        explained_by=(),
    )
    return _explained(found, level)


def _correlation_p(
    both: Matched, real: np.ndarray, sim: np.ndarray, random: np.random.Generator
) -> float | None:
    """Return the p-value of equal correlations of the poses, shapes (P,) and (Q,)."""
    if both.poses is None:
        return permutation_p(real, sim, random)
    keys = list(both.poses)
    return sign_flip_p(real[keys] - sim[[both.poses[key] for key in keys]], random)


def _explained(found: NoiseComparison, level: float) -> NoiseComparison:
    """Name what explains differences that are significant and large enough."""
    causes: list[str] = []
    material = found.ratio is None or abs(found.ratio - 1.0) > _MATERIAL_RATIO
    if material and found.p_value is not None and found.p_value < level:
        parts = contributions(found.real) - contributions(found.sim)
        sign = 1.0 if found.ratio is None or found.ratio > 1.0 else -1.0
        causes.append(_CAUSES[int(np.argmax(sign * parts))])
    if found.correlation_p is not None and found.correlation_p < level:
        apart = found.real.correlation[:, 0].mean() - found.sim.correlation[:, 0].mean()
        if abs(apart) > _MATERIAL_CORRELATION:
            causes.append(_FILTER)
    if found.frames_p is not None and found.frames_p < level:
        apart = found.real.frame_correlation - found.sim.frame_correlation
        if abs(apart) > _MATERIAL_CORRELATION:
            causes.append(_TIME_FILTER)
    return NoiseComparison(**{**found.__dict__, "explained_by": tuple(causes)})


def contributions(noise: NoiseMeasurement) -> np.ndarray:
    """Return the mean temporal variances of floor, shot noise and read noise, (3,), m^2."""
    curve = noise.curve
    table = noise.observed.table
    if curve.reference_amplitude is None:
        darkness = (table.distance / curve.reference_distance_m) ** 2
    else:
        with np.errstate(divide="ignore"):
            darkness = curve.reference_amplitude / table.amplitude
    darkness = darkness[np.isfinite(darkness)].clip(max=1.0 / curve.least_brightness)
    parts = [curve.floor_m, curve.shot_m, curve.read_m]
    mean = np.array([part**2 * np.mean(darkness**k) for k, part in enumerate(parts)])
    return mean * (1.0 - curve.fixed_share)


def _parts(noise: NoiseMeasurement) -> dict[str, Any]:
    """Return what one recording shows by itself."""
    curve = noise.curve
    return {
        "temporal_mm": _mm(noise.temporal_m),
        "temporal_ci": [_mm(end) if np.isfinite(end) else None for end in noise.temporal_interval],
        "pattern_mm": _mm(noise.pattern_m),
        "scene_mm": None if noise.scene_m is None else _mm(noise.scene_m),
        "correlation_row": _finite(noise.correlation[0]),
        "correlation_column": _finite(noise.correlation[1]),
        "frame_correlation": round(noise.frame_correlation, 4),
        "correlation_px": round(curve.correlation_px, 3),
        "curve": curve.model_dump(exclude={"fixed_seed"}),
        "poses": noise.num_poses,
        "repeated_poses": noise.repeated_poses,
    }


def _finite(values: np.ndarray) -> list[float | None]:
    return [round(value, 4) if np.isfinite(value) else None for value in values.tolist()]


def _rounded(interval: Interval | None) -> list[float] | None:
    return None if interval is None else [round(end, 4) for end in interval]


def _mm(metres: float) -> float:
    return round(metres * 1e3, 4)
