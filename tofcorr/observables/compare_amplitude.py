"""Compares the amplitudes of a recording with those of a simulated one: level, slope, image."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from tofcorr.observables.image_border import border_of
from tofcorr.observables.matched import Matched
from tofcorr.observables.pose_tests import Interval, bootstrap, permutation_p, sign_flip_p

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
        slope: Of ln real amplitude over ln simulated amplitude, or over that of ln cos / d^2; 1:
            both respond alike. At the same poses it is the ratio of the spreads, which target
            patterns that lie differently do not change.
        slope_interval: Its 95 % interval; None: fewer than six poses.
        border_ratio: Ratio in the outer eighth of the image over that in the rest.
        border_p: P-value of a border ratio of one; None: fewer than six poses.
        paired: Whether both show the same poses.
        explained_by: What of the camera the simulator lacks; empty where nothing is significant and
            material.
    """

    ratio: float
    ratio_interval: Interval | None
    p_value: float | None
    slope: float
    slope_interval: Interval | None
    border_ratio: float
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
    both: Matched, shape: tuple[int, int], random: np.random.Generator, level: float
) -> AmplitudeComparison | None:
    """Compare the amplitudes; None where one of the recordings has none at the pixels compared.

    Args:
        both: The pixels to compare.
        shape: Height and width of the images.
        random: Of resamples and permutations.
        level: Significance level.
    """
    logs = [_log(both.real.amplitude), _log(both.sim.amplitude)]
    level_logs = logs
    if not both.paired:
        level_logs = [
            log - _log(table.signal) for log, table in zip(logs, (both.real, both.sim), strict=True)
        ]
    sums = both.sums(level_logs[0], level_logs[1])
    if not len(sums.real.total) or not len(sums.sim.total):
        return None
    real, sim = sums.means()
    interval = sums.difference_interval(random)
    products = _pose_products(both, logs)
    slope = _slope(both, products)
    slope_interval = bootstrap(lambda r: _slope(both, products, r), sums.num_poses, random)
    border, border_p = _border(both, level_logs, border_of(shape), random)
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
    if ends is not None and not ends[0] <= 1.0 <= ends[1] and abs(found.slope - 1.0) > _MATERIAL:
        causes.append("response that is not linear")
    if _matters(found.border_ratio, found.border_p, level):
        causes.append("vignetting of lens and light source")
    return tuple(causes)


def _matters(ratio: float, p_value: float | None, level: float) -> bool:
    return p_value is not None and p_value < level and abs(ratio - 1.0) > _MATERIAL


def _slope(
    both: Matched, slopes: tuple[np.ndarray, np.ndarray], random: np.random.Generator | None = None
) -> float:
    """Return the slope of real over simulated ln amplitude, of all poses or of resampled ones."""
    real, sim = slopes
    if random is not None:
        drawn = random.integers(len(real), size=len(real))
        other = drawn if both.paired else random.integers(len(sim), size=len(sim))
        real, sim = real[drawn], sim[other]
    first, second = (_coefficient(sums.sum(0), own=both.paired) for sums in (real, sim))
    return first / second if second > 0 else float("nan")


def _products(x: np.ndarray, y: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Return the sums of 1, x, y, xx, xy, yy over the pixels of each pose, (P, 6)."""
    known = np.isfinite(x) & np.isfinite(y)
    x, y = x[known], y[known]
    _, row = np.unique(pose[known], return_inverse=True)
    columns = (np.ones_like(x), x, y, x * x, x * y, y * y)
    return np.stack([np.bincount(row, column) for column in columns], axis=1)


def _coefficient(sums: np.ndarray, *, own: bool) -> float:
    """Return the standard deviation of y, or (not `own`) the slope of the line of y over x."""
    count, x, y, xx, xy, yy = sums
    if own:
        return float(max(yy / count - (y / count) ** 2, 0.0) ** 0.5)
    spread = xx / count - (x / count) ** 2
    return float((xy / count - x * y / count**2) / spread) if spread > 0 else float("nan")


def _pose_products(both: Matched, logs: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    tables = (both.real, both.sim)
    against = [_log(table.signal) for table in tables]
    if both.paired:
        known = np.isfinite(logs[0]) & np.isfinite(logs[1])
        against = [np.where(known, 0.0, np.nan)] * 2
    poses = (both.real.pose, both.real.pose if both.paired else both.sim.pose)
    first, second = (_products(x, y, pose) for x, y, pose in zip(against, logs, poses, strict=True))
    return first, second


def _border(
    both: Matched, logs: list[np.ndarray], border: np.ndarray, random: np.random.Generator
) -> tuple[float, float | None]:
    """Return the ratio at the border over that in the centre, and its p-value."""
    flat = border.ravel()
    tables = (both.real, both.sim)
    contrast = []
    if both.paired:
        logs = [logs[0] - logs[1]]
    for table, values in zip(tables, logs, strict=False):
        sides = []
        for side in (flat, ~flat):
            use = np.isfinite(values) & side[table.pixel]
            size = int(table.pose.max()) + 1
            total = np.bincount(table.pose[use], values[use], minlength=size)
            count = np.bincount(table.pose[use], minlength=size)
            sides.append(np.divide(total, count, out=np.full_like(total, np.nan), where=count > 0))
        contrast.append((sides[0] - sides[1])[np.isfinite(sides[0] - sides[1])])
    if not all(len(each) for each in contrast):
        return float("nan"), None
    if both.paired:
        return float(np.exp(contrast[0].mean())), sign_flip_p(contrast[0], random)
    ratio = float(np.exp(contrast[0].mean() - contrast[1].mean()))
    return ratio, permutation_p(contrast[0], contrast[1], random)


def _ends(interval: Interval | None) -> list[float | None] | None:
    return None if interval is None else [_significant(end) for end in interval]


def _significant(value: float) -> float | None:
    """Return five significant digits: units of amplitude differ widely. None: not known."""
    return float(f"{value:.5g}") if np.isfinite(value) else None


def _log(values: np.ndarray) -> np.ndarray:
    return np.log(np.where(values > 0, values, np.nan))
