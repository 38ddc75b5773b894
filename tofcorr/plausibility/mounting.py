"""Whether some of the frames see from a camera that sits elsewhere on the tool.

A knock, or a camera taken off and mounted again, turns and shifts what every later frame sees; a
robot program that changes its tool frame does so for some frames, in any order. Each frame is
reduced to the offset and the two tilts of its plane, which is all that poses move, and two
hand-eye transforms are compared with one. What a change of the distances by a constant explains is
no step.
"""

import math
from typing import NamedTuple

import numpy as np

from tofcorr.plausibility.alignment import distinct
from tofcorr.plausibility.linear import LinearResiduals

FEWEST_FOR_STEP = 14
"""Distinct poses from which offsets and tilts are compared. Chosen: the unknowns of camera and
error, some twenty, and those of a step leave fourteen of the three numbers of each."""
FEWEST_FOR_PARTS = 20
"""Distinct poses from which two parts are looked for. Chosen: two hand-eye transforms have twelve
unknowns, and some parts of few frames always differ."""

# Prior standard deviation of a step, metres and radians. Chosen: who moves a camera by more starts
# a new recording; without it, parts could disagree by metres in what they do not determine.
_PRIOR = 0.05
# A step moves points by so many metres. Chosen.
_LEAST_SIZE = 1e-3
# F and the share of the sum of squares that a step must reach. At one moment: of 24 recordings of
# 20 or 40 frames, knocked by 8 mm and a degree, all had that, F from 17 and the share from 0.76 on;
# of 361 clean ones, or with another error, two had it.
_LEAST_AT_A_MOMENT = (15.0, 0.7)
# Of fewer than 20 frames, and of parts in any order, which are chosen to differ. Of 20 recordings
# of 14 to 19 frames, knocked by 8 mm and a degree, 18 had that, and none of 220 clean ones or with
# another error, whose F reached 29; of 24 of a tool frame 20 mm and 2 degrees away all had it; of
# 391 others none: the largest share was 0.88, of poses 12 mm late.
_LEAST_OTHERWISE = (50.0, 0.9)


class CameraStep(NamedTuple):
    """Two parts of the frames, and what a camera elsewhere in one of them explains.

    Attributes:
        frames: Indices of the frames of one part, rising.
        size: How far the step moves points off their planes, root mean square over the frames of
            the smaller part, metres.
        ratio: F: what each of its six unknowns takes off, over the variance that is left.
        share: Share of the sum of squares that it takes off.
    """

    frames: np.ndarray
    size: float
    ratio: float
    share: float

    def counts(self, least: tuple[float, float]) -> bool:
        """Whether there surely is one, and whether it matters."""
        return self.ratio > least[0] and self.share > least[1] and self.size > _LEAST_SIZE


class Mounting:
    """N frames of distinct poses, in the order in which they were recorded, weighted.

    Args:
        problem: The residuals near their alignment.

    Attributes:
        frame: Index of each in the scene, shape (N,), rising.
        step: Change of offset and tilts, metres, by a constant of the distance and by a twist of
            the camera on the tool, shape (N, 3, 7).
    """

    def __init__(self, problem: LinearResiduals) -> None:
        chosen = distinct(problem.scene.poses)
        count = np.maximum(problem.used.sum(1), 1)
        weight = np.sqrt(problem.weight.max(1))
        scale = weight / max(float(np.median(weight)), 1e-12) / np.sqrt(count)
        twist = np.concatenate([problem.cosine[..., None], problem.rigid], axis=-1)
        columns, residual, step = (
            np.einsum("f,fpa,fpk->fak", scale, problem.plane_directions, part, optimize=True)[
                chosen
            ]
            for part in (problem.columns, problem.residual[..., None], twist)
        )
        kept = _agreeing(columns, residual)
        self.frame, self.step, self._residual = chosen[kept], step[kept], residual[kept]
        self._basis = np.linalg.qr(_stacked(columns[kept]))[0]
        self._left = self._beside(_stacked(self._residual))[:, 0]

    def _beside(self, columns: np.ndarray) -> np.ndarray:
        """Return what the calibration's unknowns leave of columns (3 N, K)."""
        return columns - self._basis @ (self._basis.T @ columns)

    def _solved(self, columns: np.ndarray) -> tuple[np.ndarray, float]:
        """Return the unknowns of columns under their prior, and its weight."""
        left, count = self._left, columns.shape[1]
        prior = max(float(left @ left) / len(left), 1e-18) / _PRIOR**2
        held = np.concatenate([columns, math.sqrt(prior) * np.eye(count)])
        return np.linalg.lstsq(held, np.append(left, np.zeros(count)), rcond=None)[0], prior

    def compared(self, chosen: np.ndarray) -> CameraStep:
        """Compare a step of the distances with one of the camera as well, for chosen frames."""
        columns = self._beside(_stacked(self.step * chosen[:, None, None]))
        constant, left = columns[:, :1], self._left
        before = left - constant @ np.linalg.lstsq(constant, left, rcond=None)[0]
        square = float(before @ before)
        unknowns, prior = self._solved(columns)
        now = left - columns @ unknowns
        gained = square - float(now @ now) - prior * float(unknowns @ unknowns)
        freedom = len(left) - self._basis.shape[1] - columns.shape[1]
        ratio = gained / (columns.shape[1] - 1) / max(float(now @ now) / max(freedom, 1), 1e-18)
        smaller = max(min(int(chosen.sum()), int((~chosen).sum())), 1)
        return CameraStep(
            frames=self.frame[chosen],
            size=math.sqrt(max(gained, 0.0) / smaller),
            ratio=ratio if freedom > 0 else 0.0,
            share=gained / max(square, 1e-18),
        )

    @property
    def _fewest(self) -> int:
        """How many of the frames the smaller part must have: six, and a sixth of them.

        Six unknowns, three from a frame; smaller parts are single wrong poses.
        """
        return max(6, len(self.frame) // 6)

    def moment(self, moments: int = 41) -> CameraStep | None:
        """Return the step at one of some moments that surely is one; None: there is none."""
        number, least = len(self.frame), self._fewest
        if number < 2 * least:
            return None
        tried = np.unique(np.linspace(least, number - least, moments).astype(int))
        found = [self.compared(np.arange(number) >= moment) for moment in tried]
        best = max(found, key=lambda one: one.ratio)
        few = number < FEWEST_FOR_PARTS
        return best if best.counts(_LEAST_OTHERWISE if few else _LEAST_AT_A_MOMENT) else None

    def parts(self) -> CameraStep | None:
        """Return the two parts of the frames that differ most, in any order; None: none does.

        Which frames they are is not known: a few frames drawn at random fix a twist of the camera,
        those that agree best with one of many such twists are one part, and parts and twists are
        then improved in turn.
        """
        if len(self.frame) < FEWEST_FOR_PARTS:
            return None
        found = [one for start in self._starts() if (one := self._improved(start)) is not None]
        best = max(map(self.compared, found), key=lambda one: one.share, default=None)
        return best if best is not None and best.counts(_LEAST_OTHERWISE) else None

    def _starts(
        self, twists: int = 100, frames: int = 3, kept: int = 60, ridge: float = 1e-4
    ) -> list[np.ndarray]:
        """Return halves of the frames, (N,) bool, that agree best with a twist of some frames.

        Args:
            twists: Tried; of two parts of half the frames, one draw in four is of one part alone.
            frames: That fix one; three have nine numbers, a constant and a twist seven.
            kept: Best of them; of 20 recordings of 22 poses, 60 found the true parts in all.
            ridge: Share of a twist's mean information that is added to each of its directions: it
                only decides what three frames do not determine.
        """
        number, size = len(self.frame), self.step.shape[-1]
        step = self.step / np.maximum(np.sqrt(np.square(self.step).mean(axis=(0, 1))), 1e-12)
        drawn = np.random.default_rng(number).random((twists, number)).argsort(axis=1)[:, :frames]
        columns = step[drawn].reshape(twists, -1, size)
        matrix = columns.mT @ columns
        matrix = matrix + ridge * np.trace(matrix, axis1=1, axis2=2)[:, None, None] * np.eye(size)
        right = columns.mT @ self._residual[drawn].reshape(twists, -1, 1)
        twist = np.linalg.solve(matrix, right)[..., 0]
        explained = np.einsum("fak,sk->sfa", step, twist)
        off = np.square(self._residual[..., 0] - explained).sum(axis=2)
        agreeing = np.sort(off, axis=1)[:, : number // 2].sum(axis=1)
        return [one <= np.median(one) for one in off[np.argsort(agreeing)[:kept]]]

    def _improved(self, chosen: np.ndarray, rounds: int = 30) -> np.ndarray | None:
        """Put every frame to the part that explains it better, until none changes."""
        for _ in range(rounds):
            if min(int(chosen.sum()), int((~chosen).sum())) < self._fewest:
                return None
            own = chosen[:, None, None]
            unknowns = self._solved(self._beside(_stacked(self.step * own)))[0]
            step = (self.step @ unknowns)[..., None]
            left = self._beside(_stacked(self._residual - step * own))
            first = left.reshape(self._residual.shape) + step * own
            nearer = np.square(first - step).sum(axis=(1, 2)) < np.square(first).sum(axis=(1, 2))
            if (nearer == chosen).all():
                break
            chosen = nearer
        return chosen


def _agreeing(columns: np.ndarray, residual: np.ndarray, times: float = 5.0) -> np.ndarray:
    """Return which frames (F,) do not, as single ones, disagree with all others.

    Frames with so many times the median residual are left out, unless they are more than a tenth:
    then they may be a part by itself.
    """
    kept = np.ones(len(columns), dtype=bool)
    for _ in range(2):
        fitted = np.linalg.lstsq(_stacked(columns[kept]), _stacked(residual[kept]), rcond=None)[0]
        left = np.linalg.norm(residual - columns @ fitted, axis=(1, 2))
        kept = left < times * np.median(left)
    return kept if (~kept).sum() <= len(kept) / 10 else np.ones_like(kept)


def _stacked(parts: np.ndarray) -> np.ndarray:
    """Return (F, 3, K) as (3 F, K)."""
    return parts.reshape(-1, parts.shape[-1])
