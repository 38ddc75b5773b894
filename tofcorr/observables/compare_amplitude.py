"""Compares the amplitudes of a recording with those of a simulated one: level, slope, image."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from tofcorr.observables.image_border import border_of
from tofcorr.observables.matched import Matched
from tofcorr.observables.neighbours import quotient
from tofcorr.observables.pose_tests import Interval, bootstrap, sign_flip_p

# Smallest deviation from one that is reported, of ratio, slope, and border over centre. Chosen: the
# amplitude enters errors and noise with an exponent of one at most.
_MATERIAL = 0.05


@dataclass(frozen=True, kw_only=True, eq=False)
class AmplitudeComparison:
    """Real over simulated amplitude: at the same pixels, or each relative to cos / d^2.

    Attributes:
        ratio: Geometric mean over the pixels compared.
        ratio_interval: Its 95 % interval; None: fewer than six poses.
        p_value: Of a ratio of one; None: fewer than six poses.
        slope: Standard deviation of ln real amplitude over that of ln simulated amplitude; 1: both
            respond alike. Target patterns that lie differently do not change it. None: other poses.
        slope_interval: Its 95 % interval; None: fewer than six poses.
        border_ratio: Ratio in the outer eighth of the image over that in the rest. None: other
            poses.
        border_p: P-value of a border ratio of one; None: fewer than six poses.
        paired: Whether both show the same poses.
        explained_by: What of the camera the simulator lacks; empty where nothing is significant and
            material.
    """

    ratio: float
    ratio_interval: Interval | None
    p_value: float | None
    slope: float | None
    slope_interval: Interval | None
    border_ratio: float | None
    border_p: float | None
    paired: bool
    explained_by: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """Return the block `amplitude` of diagnosis.json."""
        return {
            "ratio": _significant(self.ratio),
            "ratio_ci": _ends(self.ratio_interval),
            "p_value": self.p_value,
            "slope": _significant(self.slope),
            "slope_ci": _ends(self.slope_interval),
            "border_ratio": _significant(self.border_ratio),
            "border_p_value": self.border_p,
            "same_poses": self.paired,
            "explained_by": list(self.explained_by),
        }


def compare_amplitude(
    both: Matched,
    amplitudes: tuple[np.ndarray, np.ndarray],
    shape: tuple[int, int],
    random: np.random.Generator,
    level: float,
) -> AmplitudeComparison | None:
    """Compare the amplitudes; None where one of the recordings has none at the pixels compared.

    Args:
        both: The pixels to compare; those of other poses matched by cos / d^2.
        amplitudes: Amplitude of each row of both tables, also of missing pixels, counts.
        shape: Height and width of the images.
        random: Of resamples and permutations.
        level: Significance level.
    """
    logs = [_log(amplitudes[0][both.rows]), _log(amplitudes[1][both.columns])]
    if not both.paired:
        logs = [log - _log(t.signal) for log, t in zip(logs, (both.real, both.sim), strict=True)]
    sums = both.sums(logs[0], logs[1])
    if not len(sums.real.total) or not len(sums.sim.total):
        return None
    real, sim = sums.means()
    interval = sums.difference_interval(random)
    slope = slope_interval = border = border_p = None
    if both.paired:
        products = _products(logs[0], logs[1], both.real.pose)
        slope = _slope(products)
        slope_interval = bootstrap(lambda r: _resampled_slope(products, r), len(products), random)
        border, border_p = _border(both, logs[0] - logs[1], border_of(shape), random)
    found = AmplitudeComparison(
        ratio=float(np.exp(real - sim)),
        ratio_interval=None if interval is None else tuple(np.exp(interval).tolist()),
        p_value=sums.difference_p(random),
        slope=slope,
        slope_interval=slope_interval,
        border_ratio=border,
        border_p=border_p,
        paired=both.paired,
        explained_by=(),
    )
    return AmplitudeComparison(**{**found.__dict__, "explained_by": _causes(found, level)})


def _causes(found: AmplitudeComparison, level: float) -> tuple[str, ...]:
    causes = []
    if _matters(found.ratio, found.p_value, level):
        causes.append("light source or unit of the amplitude")
    ends = found.slope_interval
    beyond = ends is not None and not ends[0] <= 1.0 <= ends[1]
    if beyond and found.slope is not None and abs(found.slope - 1.0) > _MATERIAL:
        causes.append("response that is not linear")
    if _matters(found.border_ratio, found.border_p, level):
        causes.append("vignetting of lens and light source")
    return tuple(causes)


def _matters(ratio: float | None, p_value: float | None, level: float) -> bool:
    if ratio is None or p_value is None:
        return False
    return p_value < level and abs(ratio - 1.0) > _MATERIAL


def _products(real: np.ndarray, sim: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Return the sums of 1, x, y, xx, yy over the pixels of each pose, (P, 5)."""
    known = np.isfinite(real) & np.isfinite(sim)
    real, sim = real[known], sim[known]
    _, row = np.unique(pose[known], return_inverse=True)
    columns = (np.ones_like(real), real, sim, real**2, sim**2)
    return np.stack([np.bincount(row, column) for column in columns], axis=1)


def _slope(products: np.ndarray) -> float:
    """Return the standard deviation of the real over that of the simulated ln amplitude."""
    count, x, y, xx, yy = products.sum(0)
    real, sim = xx / count - (x / count) ** 2, yy / count - (y / count) ** 2
    return float(max(real / sim, 0.0) ** 0.5) if sim > 0 else float("nan")


def _resampled_slope(products: np.ndarray, random: np.random.Generator) -> float:
    return _slope(products[random.integers(len(products), size=len(products))])


def _border(
    both: Matched, ratio: np.ndarray, border: np.ndarray, random: np.random.Generator
) -> tuple[float | None, float | None]:
    """Return the ratio at the border over that in the centre, and its p-value.

    Args:
        both: The pixels, paired.
        ratio: Ln of real over simulated amplitude in each, shape (M,).
        border: Where the border is, shape (H, W), bool.
        random: Of the sign flips.
    """
    pose, size = both.real.pose, int(both.real.pose.max()) + 1
    at_border = border.ravel()[both.real.pixel]
    means = []
    for side in (at_border, ~at_border):
        use = side & np.isfinite(ratio)
        means.append(
            quotient(
                np.bincount(pose[use], ratio[use], minlength=size),
                np.bincount(pose[use], minlength=size),
            )
        )
    contrast = means[0] - means[1]
    contrast = contrast[np.isfinite(contrast)]
    if not len(contrast):
        return None, None
    return float(np.exp(contrast.mean())), sign_flip_p(contrast, random)


def _ends(interval: Interval | None) -> list[float | None] | None:
    return None if interval is None else [_significant(end) for end in interval]


def _significant(value: float | None) -> float | None:
    """Return five significant digits: units of amplitude differ widely. None: not known."""
    return None if value is None or not np.isfinite(value) else float(f"{value:.5g}")


def _log(values: np.ndarray) -> np.ndarray:
    return np.log(np.where(values > 0, values, np.nan))
