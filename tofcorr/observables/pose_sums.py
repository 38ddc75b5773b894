"""Sums of a quantity over the pixels of each pose, of a recording and a simulated one."""

from dataclasses import dataclass

import numpy as np

from tofcorr.estimation.statistics import student_quantile
from tofcorr.observables.pose_tests import (
    LEAST_POSES,
    Interval,
    bootstrap,
    permutation_p,
    sign_flip_p,
)


@dataclass(frozen=True, kw_only=True, eq=False)
class Sums:
    """Sums over the pixels of P poses, in S groups of like brightness.

    Attributes:
        total: Shape (P, S), in the unit of the quantity.
        count: Number of pixels, shape (P, S).
        left_out: Change of the logarithm of the quantity, shape (P,), when a pose is left out of
            factors that were estimated from all poses; 0: there are none.
    """

    total: np.ndarray
    count: np.ndarray
    left_out: np.ndarray | float = 0.0

    def drawn(self, poses: np.ndarray) -> "Sums":
        """Return the sums of some poses, repeats allowed."""
        return Sums(total=self.total[poses], count=self.count[poses])

    @classmethod
    def of(
        cls,
        values: np.ndarray,
        weight: np.ndarray,
        pose: np.ndarray,
        group: np.ndarray,
        size: int,
        left_out: np.ndarray | None = None,
    ) -> "Sums":
        """Sum values by pose and group.

        Args:
            values: Shape (M,); NaN is left out.
            weight: What each counts, shape (M,).
            pose: Number of the pose of each, shape (M,).
            group: Group of each, shape (M,); -1: left out.
            size: Number of groups S.
            left_out: What becomes `left_out`, of all poses, by their numbers.
        """
        use = np.isfinite(values) & (group >= 0)
        poses, row = np.unique(pose[use], return_inverse=True)
        place = row * size + group[use]
        cells = len(poses) * size
        total = np.bincount(place, weight[use] * values[use], minlength=cells)
        count = np.bincount(place, weight[use], minlength=cells)
        return cls(
            total=total.reshape(-1, size),
            count=count.reshape(-1, size),
            left_out=0.0 if left_out is None else left_out[poses],
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class PoseSums:
    """The sums of both recordings.

    Attributes:
        real: Of the recording.
        sim: Of the simulated one.
        paired: Whether row k of both is the same pose, and both hold the same pixels of it.
    """

    real: Sums
    sim: Sums
    paired: bool

    def means(self) -> tuple[float, float]:
        """Return the means of both at the real distribution over the groups that both have."""
        counts = self.real.count.sum(0), self.sim.count.sum(0)
        both = (counts[0] > 0) & (counts[1] > 0)
        if not both.any():
            return float("nan"), float("nan")
        weight = counts[0][both] / counts[0][both].sum()
        real = weight @ (self.real.total.sum(0)[both] / counts[0][both])
        sim = weight @ (self.sim.total.sum(0)[both] / counts[1][both])
        return float(real), float(sim)

    def resampled(self, random: np.random.Generator) -> "PoseSums":
        """Return the sums of poses drawn with replacement."""
        count = len(self.real.total)
        chosen = random.integers(count, size=count)
        other = chosen
        if not self.paired:
            other = random.integers(len(self.sim.total), size=len(self.sim.total))
        return PoseSums(real=self.real.drawn(chosen), sim=self.sim.drawn(other), paired=self.paired)

    @property
    def num_poses(self) -> int:
        """Number of poses of the smaller recording."""
        return min(len(self.real.total), len(self.sim.total))

    def ratio_interval(self) -> Interval | None:
        """Return the 95 % interval of the ratio of the means.

        A jackknife over poses of the logarithm. Dark poses hold most of the variance, so that few
        of many poses count: the degrees of freedom are those of Satterthwaite (1946), for poses
        whose parts of the logarithm are as uncertain as their shares w of the sum are large,
        (sum w^2)^2 / sum w^4 - 1. A percentile of resampled poses was too narrow there.

        Returns:
            None with fewer than six poses, or where the sum without one pose is not positive.
        """
        if self.num_poses < LEAST_POSES:
            return None
        parts = [self._left_out(real=True), self._left_out(real=False)]
        if self.paired:
            parts = [self._left_out(real=None)]
        variance = below = 0.0
        for logs, shares in parts:
            count = len(logs)
            part = (count - 1) / count * float(((logs - logs.mean()) ** 2).sum())
            freedom = float((shares**2).sum() ** 2 / (shares**4).sum()) - 1.0
            variance, below = variance + part, below + part**2 / max(freedom, 1.0)
        real, sim = self.means()
        if not (np.isfinite(variance) and real > 0 and sim > 0):
            return None
        freedom = variance**2 / below if below > 0 else np.inf
        reach = np.exp(student_quantile(0.975, freedom) * variance**0.5)
        return float(real / sim / reach), float(real / sim * reach)

    def _left_out(self, *, real: bool | None) -> tuple[np.ndarray, np.ndarray]:
        """Return the log ratio without each pose, and the poses' shares of the sum, both (P,).

        Args:
            real: Leave out real poses, or simulated ones; None: both at once.
        """
        sums = self.sim if real is False else self.real
        logs = np.full(len(sums.total), np.nan)
        for pose in range(len(logs)):
            rest = np.delete(np.arange(len(logs)), pose)
            means = PoseSums(
                real=self.real if real is False else self.real.drawn(rest),
                sim=self.sim if real else self.sim.drawn(rest),
                paired=self.paired,
            ).means()
            if min(means) > 0:
                logs[pose] = np.log(means[0] / means[1])
        parts = [self.real, self.sim] if real is None else [sums]
        logs += 0.0 if real is False else self.real.left_out
        logs -= 0.0 if real else self.sim.left_out
        own = sum(part.total.sum(1).clip(min=0) / part.total.sum() for part in parts)
        return logs, np.asarray(own) / np.sum(own)

    def difference_interval(self, random: np.random.Generator) -> Interval | None:
        """Return the 95 % interval of the difference of the means, real less simulated."""

        def difference(random: np.random.Generator) -> float:
            real, sim = self.resampled(random).means()
            return real - sim

        return bootstrap(difference, self.num_poses, random)

    def ratio_p(self, random: np.random.Generator) -> float | None:
        """Return the p-value of the poses' ratios to what is expected being alike."""
        logs = []
        for sums in (self.real, self.sim):
            total = sums.total.sum(1)
            expected = self._expected(sums)
            positive = (total > 0) & (expected > 0)
            share = np.divide(total, expected, out=np.ones_like(total), where=positive)
            # Pseudo-values of a jackknife: a factor that all poses share moves them together, and
            # without this term they would seem to agree.
            shared = (len(total) - 1) * (sums.left_out - np.mean(sums.left_out))
            logs.append(np.where(positive, np.log(share), np.nan) - shared)
        return self._p(logs[0], logs[1], random)

    def difference_p(self, random: np.random.Generator) -> float | None:
        """Return the p-value of the poses' means, less what is expected, being alike."""
        left = []
        for sums in (self.real, self.sim):
            count = sums.count.sum(1)
            excess = sums.total.sum(1) - self._expected(sums)
            left.append(np.divide(excess, count, out=np.full_like(excess, np.nan), where=count > 0))
        return self._p(left[0], left[1], random)

    def _expected(self, sums: Sums) -> np.ndarray:
        """Return the sum of each pose if every pixel had the mean of its group in both, (P,)."""
        total = self.real.total.sum(0) + self.sim.total.sum(0)
        count = self.real.count.sum(0) + self.sim.count.sum(0)
        mean = np.divide(total, count, out=np.zeros_like(total), where=count > 0)
        return sums.count @ mean

    def _p(self, real: np.ndarray, sim: np.ndarray, random: np.random.Generator) -> float | None:
        if self.paired:
            return sign_flip_p(real - sim, random)
        return permutation_p(real, sim, random)
