"""Pixels of a recording and of a simulated one that can be compared with each other."""

from dataclasses import dataclass

import numpy as np

from tofcorr.observables.observed import Observed
from tofcorr.observables.pairing import shared_pixels, shared_poses
from tofcorr.observables.pixel_table import PixelTable
from tofcorr.observables.pose_sums import PoseSums, Sums
from tofcorr.observables.strata import common_strata, num_strata, relative_brightness


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
        if self.paired:
            both = np.isfinite(real) & np.isfinite(sim)
            real, sim = np.where(both, real, np.nan), np.where(both, sim, np.nan)
        pose = self.real.pose if self.paired else self.sim.pose
        changes = (None, None)
        if left_out is not None:
            changes = left_out[0], self._by_pose_of_sums(left_out[1], len(left_out[0]))
        return PoseSums(
            real=Sums.of(real, counts[0], self.real.pose, self.groups[0], self.size, changes[0]),
            sim=Sums.of(sim, counts[1], pose, self.groups[1], self.size, changes[1]),
            paired=self.paired,
        )

    def _by_pose_of_sums(self, values: np.ndarray, count: int) -> np.ndarray:
        """Return values of the simulated poses by the numbers that their sums have.

        Args:
            values: By the simulated recording's own numbers, shape (Q,).
            count: Number of real poses P, whose numbers count where both show the same.

        Returns:
            Shape (P,), 0 for poses of the recording alone, or (Q,).
        """
        if self.poses is None:
            return values
        found = np.zeros(count)
        found[list(self.poses)] = values[list(self.poses.values())]
        return found


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
    poses = shared_poses(real.recording, sim.recording)
    if poses is not None:
        rows, columns = shared_pixels(*tables, poses)
        alike = np.zeros(len(rows), dtype=np.int64)
        return Matched(
            real=tables[0].select(rows),
            sim=tables[1].select(columns),
            rows=rows,
            columns=columns,
            groups=(alike, alike),
            size=1,
            poses=poses,
        )
    names = [sorted(set(each.recording.frames.target.tolist())) for each in (real, sim)]
    brightness = [table.signal for table in tables]
    if amplitudes is not None:
        brightness = relative_brightness(tables, amplitudes)
    first, second = common_strata(tables, names, brightness)
    return Matched(
        real=tables[0],
        sim=tables[1],
        rows=np.arange(len(tables[0])),
        columns=np.arange(len(tables[1])),
        groups=(first, second),
        size=num_strata(names),
        poses=None,
    )
