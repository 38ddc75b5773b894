"""Pixels of a recording and of a simulated one that can be compared with each other."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tofcorr.data.recording import Recording
from tofcorr.observables.by_pose import PoseSums, Sums
from tofcorr.observables.read import Observed, PixelTable, pose_groups

# Poses and planes agree if no entry differs by more than this, metres or no unit; so do entries of
# K, pixels. Chosen: 0.1 mm and 0.1 mrad are what files in text keep, and less than robots repeat.
_SAME_POSE, _SAME_K = 1e-4, 1e-3
# Recordings are compared pose by pose if at least this share of the real poses has a partner, and
# pixel by pixel then; otherwise as two samples. Chosen: the rest would be lost.
_LEAST_SHARED = 0.8
# Groups of brightness, of equal count in both recordings together, and the fewest pixels of one in
# either. Chosen: noise changes by less than a tenth within one; fewer say too little of its mean.
_GROUPS, _FEWEST = 20, 50


@dataclass(frozen=True, kw_only=True, eq=False)
class Matched:
    """What is compared: the same pixels of the same poses, or pixels of like brightness.

    Attributes:
        real: Pixels of the recording.
        sim: Pixels of the simulated one; row by row the same if `paired`.
        rows: Which rows of the recording's table they are.
        columns: Which rows of the simulated one's.
        groups: Group of each pixel of both; -1: not compared.
        size: Number of groups.
        poses: Simulated poses by the real ones that they equal; None: other poses.
    """

    real: PixelTable
    sim: PixelTable
    rows: np.ndarray
    columns: np.ndarray
    groups: tuple[np.ndarray, np.ndarray]
    size: int
    poses: dict[int, int] | None

    @property
    def paired(self) -> bool:
        """Whether both show the same poses."""
        return self.poses is not None

    def sums(
        self,
        real: np.ndarray,
        sim: np.ndarray,
        weights: tuple[np.ndarray, np.ndarray] | None = None,
        left_out: tuple[np.ndarray, np.ndarray] | None = None,
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
        changes, pose = left_out or (None, None), self.sim.pose
        if self.poses is not None:
            both = np.isfinite(real) & np.isfinite(sim)
            real, sim = np.where(both, real, np.nan), np.where(both, sim, np.nan)
            pose = self.real.pose
            if left_out is not None:  # By the numbers that the sums have: those of real poses.
                of_sim = np.zeros(len(left_out[0]))
                of_sim[list(self.poses)] = left_out[1][list(self.poses.values())]
                changes = left_out[0], of_sim
        return PoseSums(
            real=Sums.of(real, counts[0], self.real.pose, self.groups[0], self.size, changes[0]),
            sim=Sums.of(sim, counts[1], pose, self.groups[1], self.size, changes[1]),
            paired=self.paired,
        )


def matched(
    real: Observed, sim: Observed, amplitudes: tuple[np.ndarray, np.ndarray] | None
) -> Matched:
    """Match the pixels of two recordings.

    Args:
        real: The recording.
        sim: The simulated one.
        amplitudes: Amplitude of each row of both tables, also of missing pixels, counts. None:
            pixels of other poses are matched by cos / d^2, as amplitudes themselves must be.
    """
    tables = (real.table, sim.table)
    poses = _shared_poses(real.recording, sim.recording)
    if poses is not None:
        rows, columns = _shared_pixels(*tables, poses)
        alike = np.zeros(len(rows), dtype=np.int64)
        groups, size = (alike, alike), 1
    else:
        rows, columns = (np.arange(len(table)) for table in tables)
        names = [sorted(set(each.recording.frames.target.tolist())) for each in (real, sim)]
        groups, size = _strata(tables, names, _relative_brightness(tables, amplitudes))
    return Matched(
        real=tables[0].select(rows),
        sim=tables[1].select(columns),
        rows=rows,
        columns=columns,
        groups=groups,
        size=size,
        poses=poses,
    )


def _shared_poses(real: Recording, sim: Recording) -> dict[int, int] | None:
    """Return the numbers of the simulated poses that equal real ones, by those of the real.

    Returns:
        None if the cameras differ or fewer than four fifths of the real poses were simulated.
    """
    size = (real.camera.height, real.camera.width) == (sim.camera.height, sim.camera.width)
    if not size or np.abs(np.subtract(real.camera.matrix, sim.camera.matrix)).max() > _SAME_K:
        return None
    places = []  # Pose and plane of the first frame of each pose, (P, 20).
    for table, groups in ((each.frames, pose_groups(each)) for each in (real, sim)):
        parts = (table.world_from_tool.reshape(len(table), 16), table.normal_world)
        every = np.concatenate([*parts, table.offset[:, None]], axis=1)
        places.append(every[[frames[0] for frames in groups]])
    found, free = {}, set(range(len(places[1])))
    for number, place in enumerate(places[0]):
        apart = np.abs(places[1] - place).max(axis=1)
        same = [k for k in np.flatnonzero(apart <= _SAME_POSE).tolist() if k in free]
        if same:
            found[number] = same[0]
            free.discard(same[0])
    return found if len(found) >= _LEAST_SHARED * len(places[0]) else None


def _shared_pixels(
    real: PixelTable, sim: PixelTable, poses: dict[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the rows of the same pixels of the same poses in both tables, in the same order."""
    of_sim = {number: pose for pose, number in poses.items()}
    renamed = np.array([of_sim.get(pose, -1) for pose in range(int(sim.pose.max()) + 1)])
    size = max(int(real.pixel.max()), int(sim.pixel.max())) + 1
    keys = (real.pose * size + real.pixel, renamed[sim.pose] * size + sim.pixel)
    _, rows, columns = np.intersect1d(*keys, return_indices=True)
    paired = renamed[sim.pose[columns]] >= 0
    return rows[paired], columns[paired]


def _relative_brightness(
    tables: Sequence[PixelTable], amplitudes: Sequence[np.ndarray] | None
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
    tables: Sequence[PixelTable], names: Sequence[Sequence[str]], brightness: Sequence[np.ndarray]
) -> tuple[tuple[np.ndarray, np.ndarray], int]:
    """Return the group of each pixel of both recordings, by brightness and target.

    Args:
        tables: The pixels of both.
        names: Names of the targets of both, in alphabetical order.
        brightness: Of the pixels of both, in one unit.

    Returns:
        Group numbers, shapes (M,), -1 for pixels without brightness, of a target that only one
        recording has, or of a group with fewer than 50 pixels in either; and how many there are.
    """
    number = {name: k for k, name in enumerate(sorted(set(names[0]) & set(names[1])))}
    size = _GROUPS * max(len(number), 1)
    groups, counts = [], []
    known = np.concatenate([values[np.isfinite(values)] for values in brightness])
    edges = np.quantile(known, np.linspace(0, 1, _GROUPS + 1)[1:-1]) if len(known) else []
    for table, own, values in zip(tables, names, brightness, strict=True):
        place = np.searchsorted(edges, values)
        if number:
            of_target = np.array([number.get(name, -1) for name in own])[table.target]
            place = np.where(of_target >= 0, of_target * _GROUPS + place, -1)
        groups.append(np.where(np.isfinite(values), place, -1))
        counts.append(np.bincount(groups[-1][groups[-1] >= 0], minlength=size))
    enough = np.append((counts[0] >= _FEWEST) & (counts[1] >= _FEWEST), False)
    first, second = (np.where(enough[group], group, -1) for group in groups)
    return (first, second), size
