"""Intervals and p-values with poses as the unit: pixels of an image are no independent samples."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from tofcorr.estimation.robust import student_quantile
from tofcorr.observables.read import quotient

# Resamples of the poses for an interval, and permutations for a p-value: they resolve 1/1000. As
# many as are usual.
_DRAWS = 999
LEAST_P = 1 / (_DRAWS + 1)
"""The smallest p-value that the draws can give. Derived: the data count as one draw more."""
LEAST_POSES = 6
"""Fewest poses for which anything is tested: five signs allow 32 flips, p-values of 0.06."""

Interval = tuple[float, float]
Random = np.random.Generator


def bootstrap(draw: Callable[[Random], float], num_poses: int, random: Random) -> Interval | None:
    """Return the 95 % percentile interval of a statistic of resampled poses.

    Args:
        draw: Resamples the poses and returns the statistic.
        num_poses: Number of poses of the smaller recording.
        random: Source of the resamples.

    Returns:
        None with fewer than six poses, or where the statistic is not finite in most resamples.
    """
    if num_poses < LEAST_POSES:
        return None
    drawn = np.array([draw(random) for _ in range(_DRAWS)])
    drawn = drawn[np.isfinite(drawn)]
    if len(drawn) < _DRAWS / 2:
        return None
    low, high = np.quantile(drawn, (0.025, 0.975))
    return float(low), float(high)


def sign_flip_p(differences: np.ndarray, random: Random) -> float | None:
    """Return the two-sided p-value of paired differences having a mean of zero.

    Under the null, real and simulated could be swapped in every pose.

    Args:
        differences: Of each pose, shape (P,); NaN is left out.
        random: Source of the signs.
    """
    known = differences[np.isfinite(differences)]
    if len(known) < LEAST_POSES:
        return None
    signs = random.choice((-1.0, 1.0), size=(_DRAWS, len(known)))
    return _share_beyond(signs @ known, float(known.sum()))


def permutation_p(real: np.ndarray, sim: np.ndarray, random: Random) -> float | None:
    """Return the two-sided p-value of two samples of poses having the same mean.

    Args:
        real: Of each real pose, shape (P,); NaN is left out.
        sim: Of each simulated pose, shape (Q,); NaN is left out.
        random: Source of the permutations.
    """
    real, sim = real[np.isfinite(real)], sim[np.isfinite(sim)]
    if min(len(real), len(sim)) < LEAST_POSES:
        return None
    both = np.concatenate([real, sim])
    flags = np.zeros((_DRAWS, len(both)))
    flags[:, : len(real)] = 1.0
    share = 1.0 / len(real) + 1.0 / len(sim)
    drawn = random.permuted(flags, axis=1) @ both * share - both.sum() / len(sim)
    return _share_beyond(drawn, float(real.mean() - sim.mean()))


def _share_beyond(drawn: np.ndarray, observed: float) -> float:
    # The observed order is one of the possible ones. Equal values differ by rounding.
    beyond = np.abs(drawn) >= abs(observed) * (1 - 1e-9)
    return float((1 + beyond.sum()) / (len(drawn) + 1))


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
        place, cells = row * size + group[use], len(poses) * size
        total, count = (
            np.bincount(place, each, minlength=cells).reshape(-1, size)
            for each in (weight[use] * values[use], weight[use])
        )
        changes = 0.0 if left_out is None else left_out[poses]
        return cls(total=total, count=count, left_out=changes)


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
        variance = below = 0.0
        for sides in ("both",) if self.paired else ("real", "sim"):
            logs, shares = self._left_out(sides)
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

    def _left_out(self, sides: str) -> tuple[np.ndarray, np.ndarray]:
        """Return the log ratio without each pose, and the poses' shares of the sum, both (P,).

        Args:
            sides: Whether real or simulated poses are left out, or `both` at once.
        """
        parts = {"real": [self.real], "sim": [self.sim], "both": [self.real, self.sim]}[sides]
        logs = np.full(len(parts[0].total), np.nan)
        for pose in range(len(logs)):
            rest = np.delete(np.arange(len(logs)), pose)
            means = PoseSums(
                real=self.real if sides == "sim" else self.real.drawn(rest),
                sim=self.sim if sides == "real" else self.sim.drawn(rest),
                paired=self.paired,
            ).means()
            if min(means) > 0:
                logs[pose] = np.log(means[0] / means[1])
        logs += 0.0 if sides == "sim" else self.real.left_out
        logs -= 0.0 if sides == "real" else self.sim.left_out
        own = np.sum([part.total.sum(1).clip(min=0) / part.total.sum() for part in parts], axis=0)
        return logs, own / own.sum()

    def difference_interval(self, random: Random) -> Interval | None:
        """Return the 95 % interval of the difference of the means, real less simulated."""

        def difference(random: Random) -> float:
            counts = len(self.real.total), len(self.sim.total)
            chosen = other = random.integers(counts[0], size=counts[0])
            if not self.paired:
                other = random.integers(counts[1], size=counts[1])
            drawn = self.real.drawn(chosen), self.sim.drawn(other)
            real, sim = PoseSums(real=drawn[0], sim=drawn[1], paired=self.paired).means()
            return real - sim

        return bootstrap(difference, self.num_poses, random)

    def ratio_p(self, random: Random) -> float | None:
        """Return the p-value of the poses' ratios to what is expected being alike."""
        logs = []
        for sums in (self.real, self.sim):
            total, expected = sums.total.sum(1), self._expected(sums)
            share = np.where(total > 0, quotient(total, expected), np.nan)
            # Pseudo-values of a jackknife: a factor that all poses share moves them together, and
            # without this term they would seem to agree.
            shared = (len(total) - 1) * (sums.left_out - np.mean(sums.left_out))
            logs.append(np.log(share) - shared)
        return self._p(logs[0], logs[1], random)

    def difference_p(self, random: Random) -> float | None:
        """Return the p-value of the poses' means, less what is expected, being alike."""
        left = [
            quotient(sums.total.sum(1) - self._expected(sums), sums.count.sum(1))
            for sums in (self.real, self.sim)
        ]
        return self._p(left[0], left[1], random)

    def _expected(self, sums: Sums) -> np.ndarray:
        """Return the sum of each pose if every pixel had the mean of its group in both, (P,)."""
        total = self.real.total.sum(0) + self.sim.total.sum(0)
        count = self.real.count.sum(0) + self.sim.count.sum(0)
        return sums.count @ np.nan_to_num(quotient(total, count))

    def _p(self, real: np.ndarray, sim: np.ndarray, random: Random) -> float | None:
        if self.paired:
            return sign_flip_p(real - sim, random)
        return permutation_p(real, sim, random)
