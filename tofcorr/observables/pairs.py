"""Pixels of a recording and of a simulated one that can be compared, and tests of their means.

Poses are the unit of every interval and p-value: pixels of an image are no independent samples.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from tofcorr.data.recording import repeats_of
from tofcorr.estimation.noise import BINS
from tofcorr.estimation.robust import LEVEL, student_quantile
from tofcorr.observables.read import FEWEST_PIXELS, Observed, quotient

Interval = tuple[float, float]
Random = np.random.Generator
Pair = tuple[np.ndarray, np.ndarray]
"""One array of the recording, one of the simulated one."""

# Poses and planes agree if no entry differs by more than this, metres or no unit. Chosen: 0.1 mm
# and 0.1 mrad are what files in text keep, and less than robots repeat.
_SAME_POSE = 1e-4
# Recordings are compared pose by pose if at least this share of the real poses has a partner, and
# pixel by pixel then; otherwise as two samples. Chosen: the rest would be lost.
_LEAST_SHARED = 0.8
# Flips or permutations for a p-value: they resolve 1/1000. As many as are usual.
_DRAWS = 999
LEAST_P = 1 / (_DRAWS + 1)
"""The smallest p-value that the draws can give. Derived: the data count as one draw more."""
LEAST_POSES = 6
"""Fewest poses for which anything is tested: five signs allow 32 flips, p-values of 0.06."""


def reach(parts: Iterable[Pair]) -> float:
    """Return half of the 95 % interval of a statistic, by a jackknife over poses.

    Few of many poses may hold most of a sum. The degrees of freedom are those of Satterthwaite
    (1946), for poses whose parts of the statistic are as uncertain as their shares w of the sum are
    large, (sum w^2)^2 / sum w^4 - 1. A percentile of resampled poses was too narrow there.

    Args:
        parts: Of each set of poses: the statistic without each of them, and their shares of the
            sum, of any scale, both (P,).
    """
    variance = below = 0.0
    for values, shares in parts:
        part = (len(values) - 1) * float(values.var())
        freedom = (shares**2).sum() ** 2 / max((shares**4).sum(), np.finfo(float).tiny) - 1.0
        variance, below = variance + part, below + part**2 / max(freedom, 1.0)
    freedom = variance**2 / below if below > 0 else np.inf
    return student_quantile(1 - LEVEL / 2, freedom) * variance**0.5


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
    return _share_beyond(signs @ known, known.sum())


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
    # Weights of both samples whose sum is the difference of the means.
    weights = np.repeat([1 / len(real), -1 / len(sim)], [len(real), len(sim)])
    both = np.concatenate([real, sim])
    drawn = random.permuted(np.tile(weights, (_DRAWS, 1)), axis=1) @ both
    return _share_beyond(drawn, float(weights @ both))


def _share_beyond(drawn: np.ndarray, observed: float) -> float:
    # The observed order is one of the possible ones. Equal values differ by rounding.
    beyond = np.abs(drawn) >= abs(observed) * (1 - np.finfo(float).eps ** 0.5)
    return float((1 + beyond.sum()) / (len(drawn) + 1))


@dataclass(frozen=True, kw_only=True, eq=False)
class PoseSums:
    """Sums of a quantity over the pixels of the poses of both recordings, in S groups.

    Attributes:
        total: Shapes (P, S) and (Q, S), in the unit of the quantity.
        count: Number of pixels, of the same shapes.
        left_out: Change of the logarithm of the quantity, shapes (P,) and (Q,), when a pose is left
            out of factors that were estimated from all poses; 0: there are none.
        paired: Whether row k of both is the same pose, and both hold the same pixels of it.
    """

    total: Pair
    count: Pair
    left_out: tuple[np.ndarray | float, np.ndarray | float] = (0.0, 0.0)
    paired: bool

    def means(self, *poses: np.ndarray | slice) -> Interval:
        """Return the means of both at the real distribution over the groups that both have.

        Args:
            poses: Which poses count, of both, repeats allowed; all if they are not given.
        """
        poses = poses or (slice(None), slice(None))
        (real, sim), (in_real, in_sim) = (
            [each[chosen].sum(0) for each, chosen in zip(sums, poses, strict=True)]
            for sums in (self.total, self.count)
        )
        both = (in_real > 0) & (in_sim > 0)
        if not both.any():
            return float("nan"), float("nan")
        weight = in_real[both] / in_real[both].sum()
        ratios = real[both] / in_real[both], sim[both] / in_sim[both]
        return float(weight @ ratios[0]), float(weight @ ratios[1])

    def ratio_interval(self) -> Interval | None:
        """Return the 95 % interval of the ratio of the means, None where one is not positive."""
        ends = self._interval(lambda a, b: np.log(a / b) if min(a, b) > 0 else np.nan)
        return ends and (float(np.exp(ends[0])), float(np.exp(ends[1])))

    def difference_interval(self) -> Interval | None:
        """Return the 95 % interval of the difference of the means, real less simulated."""
        return self._interval(lambda real, sim: real - sim)

    def _interval(self, statistic: Callable[[float, float], float]) -> Interval | None:
        """Return the 95 % interval of a statistic of both means; None with fewer than six poses."""
        if min(map(len, self.total)) < LEAST_POSES:
            return None
        sides = ([0, 1],) if self.paired else ([0], [1])
        middle, half = statistic(*self.means()), reach(self._without(s, statistic) for s in sides)
        return (middle - half, middle + half) if np.isfinite(middle + half) else None

    def _without(self, sides: list[int], statistic: Callable[[float, float], float]) -> Pair:
        """Return the statistic without each pose, and the poses' shares of the sum, both (P,).

        Args:
            sides: Which poses are left out: real ones, 0, simulated ones, 1, or both at once.
            statistic: Of the real and the simulated mean.
        """
        count = len(self.total[sides[0]])
        values, shares = np.zeros((2, count))
        # Poses of the other recording may be more or fewer.
        changes = {side: np.broadcast_to(self.left_out[side], count) for side in sides}
        for pose in range(count):
            rest = np.delete(np.arange(count), pose)
            means = self.means(*(rest if side in sides else slice(None) for side in (0, 1)))
            changed = [np.exp(changes[k][pose]) if k in sides else 1.0 for k in (0, 1)]
            values[pose] = statistic(means[0] * changed[0], means[1] * changed[1])
        for side in sides:
            own = self.total[side].sum(1).clip(min=0)
            shares += own / max(own.sum(), np.finfo(float).tiny)
        return values, shares

    def ratio_p(self, random: Random) -> float | None:
        """Return the p-value of the poses' ratios to what is expected being alike."""
        logs, sides = [], zip(self.total, self._expected(), self.left_out, strict=True)
        for total, expected, left_out in sides:
            seen = total.sum(1)
            share = np.where(seen > 0, quotient(seen, expected), np.nan)
            # Pseudo-values of a jackknife: a factor that all poses share moves them together, and
            # without this term they would seem to agree.
            logs.append(np.log(share) - (len(seen) - 1) * (left_out - np.mean(left_out)))
        return self._p(logs, random)

    def difference_p(self, random: Random) -> float | None:
        """Return the p-value of the poses' means, less what is expected, being alike."""
        parts = zip(self.total, self._expected(), self.count, strict=True)
        return self._p([quotient(t.sum(1) - e, count.sum(1)) for t, e, count in parts], random)

    def _expected(self) -> Iterator[np.ndarray]:
        """Yield the sum of each pose if every pixel had the mean of its group in both."""
        total, count = (sum(part.sum(0) for part in each) for each in (self.total, self.count))
        mean = np.nan_to_num(quotient(np.asarray(total), np.asarray(count)))
        return (own @ mean for own in self.count)

    def _p(self, values: list[np.ndarray], random: Random) -> float | None:
        real, sim = values
        return sign_flip_p(real - sim, random) if self.paired else permutation_p(real, sim, random)


class Matched:
    """What is compared: the same pixels of the same poses, or pixels of like brightness.

    Args:
        real: The recording.
        sim: The simulated one.
        amplitudes: Amplitude of each row of both tables, also of missing pixels, counts. None:
            pixels of other poses are matched by cos / d^2, as amplitudes themselves must be.

    Attributes:
        real: Pixels of the recording.
        sim: Pixels of the simulated one; row by row the same if `paired`.
        rows: Which rows of the recording's table they are.
        columns: Which rows of the simulated one's.
        groups: Group of each pixel of both; -1: not compared.
        size: Number of groups.
        poses: Simulated poses by the real ones that they equal; None: other poses.
        paired: Whether both show the same poses.
    """

    def __init__(self, real: Observed, sim: Observed, amplitudes: Pair | None) -> None:
        tables = (real.table, sim.table)
        self.poses = _shared_poses(real, sim)
        self.paired = self.poses is not None
        if self.poses is not None:
            self.rows, self.columns = _shared_pixels(*tables, self.poses)
            alike = np.zeros(len(self.rows), dtype=np.int64)
            self.groups, self.size = (alike, alike), 1
        else:
            self.rows, self.columns = (np.arange(len(table)) for table in tables)
            names = [sorted(set(each.recording.frames.target.tolist())) for each in (real, sim)]
            brightness = _relative_brightness(tables, amplitudes)
            self.groups, self.size = _strata(tables, names, brightness)
        self.real = tables[0][self.rows].view(np.recarray)
        self.sim = tables[1][self.columns].view(np.recarray)

    def sums(
        self,
        real: np.ndarray,
        sim: np.ndarray,
        weights: Pair | None = None,
        left_out: Pair | None = None,
    ) -> PoseSums:
        """Return the sums of a quantity by pose.

        Args:
            real: The quantity in each pixel of `real`, shape (M,); NaN: unknown.
            sim: The same of `sim`.
            weights: What each pixel counts in both; None: one.
            left_out: Change of the logarithm of both when a pose is left out of factors estimated
                from all poses, by their numbers; None: there are none.
        """
        counts = (np.ones(len(real)), np.ones(len(sim))) if weights is None else weights
        changes, poses = left_out, (self.real.pose, self.sim.pose)
        if self.poses is not None:
            unknown = ~(np.isfinite(real) & np.isfinite(sim))
            real, sim = np.where(unknown, np.nan, (real, sim))
            poses = self.real.pose, self.real.pose
            if left_out is not None:  # By the numbers that the sums have: those of real poses.
                of_sim = np.zeros(len(left_out[0]))
                of_sim[list(self.poses)] = left_out[1][list(self.poses.values())]
                changes = left_out[0], of_sim
        parts = []
        for k, values in enumerate((real, sim)):
            use = np.isfinite(values) & (self.groups[k] >= 0)
            numbers, row = np.unique(poses[k][use], return_inverse=True)
            place, shape = row * self.size + self.groups[k][use], (len(numbers), self.size)
            weight = counts[k][use]
            total, count = (
                np.bincount(place, each, minlength=shape[0] * shape[1]).reshape(shape)
                for each in (weight * values[use], weight)
            )
            parts.append((total, count, 0.0 if changes is None else changes[k][numbers]))
        total, count, changed = zip(*parts, strict=True)
        return PoseSums(total=total, count=count, left_out=changed, paired=self.paired)


def _shared_poses(real: Observed, sim: Observed) -> dict[int, int] | None:
    """Return the numbers of the simulated poses that equal real ones, by those of the real.

    Returns:
        None if the cameras differ or fewer than four fifths of the real poses were simulated.
    """
    cameras = [each.recording.camera for each in (real, sim)]
    same_size = real.map_frames.shape == sim.map_frames.shape
    if not same_size or not np.allclose(cameras[0].matrix, cameras[1].matrix):
        return None
    # Pose and plane of the first frame of each pose, (P, 20); its target and exposure, (P, 2).
    places, seen = [], []
    for recording in (real.recording, sim.recording):
        first, table = [frames[0] for frames in repeats_of(recording)], recording.frames
        poses = table.world_from_tool.reshape(len(table), 16)
        every = np.column_stack([poses, table.normal_world, table.offset])
        places.append(every[first])
        times = np.zeros(len(table)) if table.integration_time is None else table.integration_time
        seen.append(np.column_stack([table.target, times.astype(str)])[first])
    found, free = {}, np.ones(len(places[1]), dtype=bool)
    for number, place in enumerate(places[0]):
        same = np.flatnonzero(free & (np.abs(places[1] - place).max(axis=1) <= _SAME_POSE))
        if len(same):  # Targets and exposures may change at a pose, in another order.
            alike = (seen[1][same] == seen[0][number]).sum(axis=1)
            found[number] = int(same[alike.argmax()])
            free[found[number]] = False
    return found if len(found) >= _LEAST_SHARED * len(places[0]) else None


def _shared_pixels(real: np.recarray, sim: np.recarray, poses: dict[int, int]) -> Pair:
    """Return the rows of the same pixels of the same poses in both tables, in the same order."""
    renamed = np.full(max(int(sim.pose.max()), *poses.values()) + 1, -1)
    renamed[list(poses.values())] = list(poses)
    size = max(int(real.pixel.max()), int(sim.pixel.max())) + 1
    keys = (real.pose * size + real.pixel, renamed[sim.pose] * size + sim.pixel)
    _, rows, columns = np.intersect1d(*keys, return_indices=True)
    return rows, columns


def _relative_brightness(
    tables: tuple[np.recarray, np.recarray], amplitudes: Pair | None
) -> list[np.ndarray]:
    """Return the brightness of pixels in a unit that two recordings share.

    It is the amplitude over that of the same target, seen head-on at 1 m by the same camera: units
    of amplitude differ between simulators. Without amplitudes in either it is cos / d^2.

    Args:
        tables: The pixels of both.
        amplitudes: Of the pixels of both, counts; NaN where unknown; None: not to be used.
    """
    signals = [table.signal for table in tables]
    if amplitudes is None or not all(np.isfinite(each).any() for each in amplitudes):
        return signals
    scaled = []
    for signal, amplitude in zip(signals, amplitudes, strict=True):
        known = np.isfinite(amplitude) & np.isfinite(signal)
        # The brighter half: there a threshold takes no pixel away.
        known &= signal >= np.median(signal[known]) if known.any() else False
        scale = float(np.median(amplitude[known] / signal[known])) if known.any() else np.nan
        scaled.append(amplitude / scale)
    return scaled


def _strata(
    tables: tuple[np.recarray, np.recarray], names: list[list[str]], brightness: list[np.ndarray]
) -> tuple[Pair, int]:
    """Return the group of each pixel of both recordings, by brightness and target.

    Args:
        tables: The pixels of both.
        names: Names of the targets of both, in alphabetical order.
        brightness: Of the pixels of both, in one unit.

    Returns:
        Group numbers, shapes (M,), -1 for pixels without brightness, of a target that only one
        recording has, or of a group with fewer than 100 pixels in either; and how many there are.
    """
    number = {name: k for k, name in enumerate(sorted(set(names[0]) & set(names[1])))}
    size = BINS * max(len(number), 1)
    groups, counts = [], []
    known = np.concatenate([values[np.isfinite(values)] for values in brightness])
    edges = np.quantile(known, np.linspace(0, 1, BINS + 1)[1:-1]) if len(known) else []
    for table, own, values in zip(tables, names, brightness, strict=True):
        place = np.searchsorted(edges, values)
        if number:
            of_target = np.array([number.get(name, -1) for name in own])[table.target]
            place = np.where(of_target >= 0, of_target * BINS + place, -1)
        groups.append(np.where(np.isfinite(values), place, -1))
        counts.append(np.bincount(groups[-1][groups[-1] >= 0], minlength=size))
    enough = np.append((counts[0] >= FEWEST_PIXELS) & (counts[1] >= FEWEST_PIXELS), False)
    first, second = (np.where(enough[group], group, -1) for group in groups)
    return (first, second), size
