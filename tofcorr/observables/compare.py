"""Compares what a recording and a simulated one show beside their bias.

Each comparison is a block of `diagnosis.json`; its `explained_by` says what of the camera the
simulator lacks or exaggerates, and is empty where nothing is significant and material.
"""

from typing import Any

import numpy as np

from tofcorr.data.recording import Recording
from tofcorr.estimation.noise import Source
from tofcorr.estimation.robust import LEVEL
from tofcorr.observables.measure import (
    DropoutMeasurement,
    NoiseMeasurement,
    noise_source,
)
from tofcorr.observables.pairs import (
    Matched,
    Random,
    permutation_p,
    sign_flip_p,
)
from tofcorr.observables.read import Observed, log_of

Block = dict[str, Any]
# Smallest deviation that is reported: of a ratio from one, and of a correlation; and of the shares
# of missing pixels. Chosen: what trains a network on simulated depth does not notice less; one
# pixel in 500 is what the check of simulated pairs measures the share to.
_MATERIAL, _MATERIAL_SHARE = 0.05, 0.002


class Observables:
    """Noise, missing pixels and amplitude of a recording, and of a simulated one if there is one.

    They are compared with poses as the unit of every test. At the same poses the same pixels are
    compared. At other poses, pixels of like brightness and target are: brightness is the amplitude
    in a unit that both share, or cos / d^2.

    Args:
        real: The recording.
        sim: The simulated one, with the noise that the simulator states; None: the recording alone
            is measured.
        seed: Of resamples and permutations.
        level: Significance level of what is reported.

    Raises:
        CalibrationDataError: One of them has no image with 100 usable pixels, or breaks the format.

    Attributes:
        real_noise: Noise of the recording, by its best source.
        real_dropouts: Missing and saturated pixels of the recording.
        noises: Noise of both from one source, so that its errors cancel; None without a simulated
            recording.
        sim_dropouts: Missing and saturated pixels of the simulated one; None without.
        noise, dropouts, amplitude: The comparisons: blocks of diagnosis.json; None without a
            simulated recording, or if one of the recordings has no amplitude.
        both: The pixels compared; None without a simulated recording.
    """

    def __init__(
        self, real: Recording, sim: Recording | None, *, seed: int, level: float = LEVEL
    ) -> None:
        seen = Observed(real)
        self.real_noise, self.real_dropouts = NoiseMeasurement(seen), DropoutMeasurement(seen)
        self.noises: tuple[NoiseMeasurement, NoiseMeasurement] | None = None
        self.noise = self.dropouts = self.amplitude = self.sim_dropouts = self.both = None
        if sim is None:
            return
        simulated, noise = Observed(sim), self.real_noise
        self.sim_dropouts = DropoutMeasurement(simulated)
        lost = self.real_dropouts, self.sim_dropouts
        self.both = Matched(seen, simulated, (lost[0].amplitude, lost[1].amplitude))
        alike = self.both if self.both.paired else Matched(seen, simulated, None)
        source: Source = noise.source
        if noise_source(simulated) != source:
            source, noise = "neighbours", NoiseMeasurement(seen, "neighbours")
        self.noises = noise, NoiseMeasurement(simulated, source)
        random = np.random.default_rng(seed)
        self.noise = _compare_noise(self.both, *self.noises, random, level)
        self.dropouts = _compare_dropouts(self.both, *lost, random, level)
        self.amplitude = _compare_amplitude(alike, *lost, random, level)

    def to_dict(self) -> dict[str, Any]:
        """Return the blocks `noise`, `dropouts` and `amplitude` of diagnosis.json."""
        return {"noise": self.noise, "dropouts": self.dropouts, "amplitude": self.amplitude}

    @property
    def explained_by(self) -> tuple[str, ...]:
        """What of the camera the simulator lacks or exaggerates; empty: nothing was found."""
        blocks = (block for block in self.to_dict().values() if block is not None)
        return tuple(cause for block in blocks for cause in block["explained_by"])


def _causes(level: float, *found: tuple[str, float | None, float | None, float]) -> list[str]:
    """Return the causes of what is significant and material, each once.

    Args:
        level: Significance level.
        found: Cause, deviation, its p-value, and the least deviation that matters; None: unknown.
    """
    causes = [
        cause
        for cause, deviation, p_value, least in found
        if deviation is not None and abs(deviation) > least
        if p_value is not None and p_value < level
    ]
    return list(dict.fromkeys(causes))


def _compare_noise(
    both: Matched, real: NoiseMeasurement, sim: NoiseMeasurement, random: Random, level: float
) -> Block:
    """Compare the temporal noise; return the block `noise`, lengths in millimetres."""
    variances = real.variance[both.rows], sim.variance[both.columns]
    sums = both.sums(*variances, left_out=(real.left_out, sim.left_out))
    means = [max(mean, 0.0) ** 0.5 for mean in np.nan_to_num(sums.means()).tolist()]
    ratio = squares = None
    p_values: list[float | None] = [None, None]
    # Float32 depth is rounded by less.
    if means[1] > np.finfo(np.float32).eps * np.nanmax(sim.observed.table.distance):
        ratio, squares = means[0] / means[1], sums.ratio_interval()
        p_value = sums.ratio_p(random)
        p_values = [
            _correlation_p(both, getattr(real, name), getattr(sim, name), random)
            for name in ("pose_correlation", "pose_frame_correlation")
        ]
    else:
        p_value = sums.difference_p(random)
    more = np.inf if ratio is None else ratio - 1.0
    parts = ("noise floor", "shot noise", "read noise")
    largest = parts[np.argmax(np.sign(more) * (contributions(real) - contributions(sim)))]
    near = float(real.correlation[:, 0].mean() - sim.correlation[:, 0].mean())
    later = real.frame_correlation - sim.frame_correlation
    return {
        "real_mm": round(1e3 * means[0], 4),
        "sim_mm": round(1e3 * means[1], 4),
        "ratio": None if ratio is None else round(ratio, 4),
        "ratio_ci": squares and [round(max(end, 0.0) ** 0.5, 4) for end in squares],
        "p_value": p_value,
        "frame_correlation": round(real.frame_correlation, 4),
        "source": real.source,
        "same_poses": both.paired,
        "explained_by": _causes(
            level,
            (largest, more, p_value, _MATERIAL),
            ("edge-preserving filter of the camera", near, p_values[0], _MATERIAL),
            ("filter of the camera in time", later, p_values[1], _MATERIAL),
        ),
    }


def _correlation_p(
    both: Matched, real: np.ndarray, sim: np.ndarray, random: Random
) -> float | None:
    """Return the p-value of equal correlations of the poses, shapes (P,) and (Q,)."""
    if both.poses is None:
        return permutation_p(real, sim, random)
    return sign_flip_p(real[list(both.poses)] - sim[list(both.poses.values())], random)


def contributions(noise: NoiseMeasurement) -> np.ndarray:
    """Return the mean temporal variances of floor, shot noise and read noise, (3,), m^2."""
    curve, table = noise.curve, noise.observed.table
    darkness = 1.0 / curve.brightness(table.distance, table.amplitude)
    darkness = darkness[np.isfinite(darkness)]
    mean = [part**2 * np.mean(darkness**k) for k, part in enumerate(curve.deviations)]
    return np.array(mean) * (1.0 - curve.fixed_share)


def _compare_dropouts(
    both: Matched, real: DropoutMeasurement, sim: DropoutMeasurement, random: Random, level: float
) -> Block:
    """Compare the shares of missing and of saturated pixels; return the block `dropouts`."""
    frames = both.real.frames, both.sim.frames
    missing, saturated = (
        both.sums(both.real[name] / frames[0], both.sim[name] / frames[1], frames)
        for name in ("missing", "saturated")
    )
    (lost, lost_by_sim), full = np.nan_to_num([missing.means(), saturated.means()]).tolist()
    p_value, saturated_p = missing.difference_p(random), saturated.difference_p(random)
    cause = _cause_of_missing(real if lost > lost_by_sim else sim)
    return {
        "real_share": round(lost, 5),
        "sim_share": round(lost_by_sim, 5),
        "p_value": p_value,
        "same_poses": both.paired,
        "explained_by": _causes(
            level,
            (cause, lost - lost_by_sim, p_value, _MATERIAL_SHARE),
            ("saturation", full[0] - full[1], saturated_p, _MATERIAL_SHARE),
        ),
    }


def _cause_of_missing(dropouts: DropoutMeasurement) -> str:
    """Return what the missing pixels of a recording look like."""
    if dropouts.saturated_missing > dropouts.share / 2:
        return "saturation"
    if dropouts.model.amplitude_at_half is not None:
        return "amplitude threshold"
    if dropouts.border_share > 3 * dropouts.centre_share:
        return "missing border of the image"
    return "missing pixels at any amplitude"


def _compare_amplitude(
    both: Matched, real: DropoutMeasurement, sim: DropoutMeasurement, random: Random, level: float
) -> Block | None:
    """Compare the amplitudes: real over simulated, in the same pixels or relative to cos / d^2.

    Args:
        both: The pixels to compare; those of other poses matched by cos / d^2.
        real: Holds the amplitude of each row of the recording's table, also of missing pixels.
        sim: Of the simulated one.
        random: Of resamples and permutations.
        level: Significance level.

    Returns:
        The block `amplitude`; None where one of the recordings has none at the pixels compared.
    """
    logs = [log_of(real.amplitude[both.rows]), log_of(sim.amplitude[both.columns])]
    if not both.paired:
        logs = [logs[0] - log_of(both.real.signal), logs[1] - log_of(both.sim.signal)]
    sums = both.sums(logs[0], logs[1])
    if not all(map(len, sums.total)):
        return None
    means, interval = sums.means(), sums.difference_interval()
    ratio, p_value = float(np.exp(means[0] - means[1])), sums.difference_p(random)
    cause = "light source or unit of the amplitude"
    return {
        "ratio": _significant(ratio),
        "ratio_ci": interval and [_significant(end) for end in np.exp(interval).tolist()],
        "p_value": p_value,
        "same_poses": both.paired,
        "explained_by": _causes(level, (cause, ratio - 1.0, p_value, _MATERIAL)),
    }


def _significant(value: float) -> float:
    """Return five significant digits: units of amplitude differ widely."""
    return float(f"{value:.5g}")
