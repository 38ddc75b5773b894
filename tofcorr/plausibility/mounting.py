"""Whether some of the frames see from a camera that sits elsewhere on the tool.

A knock, or a camera taken off and mounted again, turns and shifts what every later frame sees; a
robot program that changes its tool frame does so for some frames, in any order. Each frame is
reduced to the offset and the two tilts of its plane, which is all that poses move, and two
hand-eye transforms are compared with one. What a change of the distances by a constant explains is
no step.
"""

import math
from collections.abc import Iterable, Iterator

import numpy as np

from tofcorr.estimation.uncertainty import PRIOR_SIGMA
from tofcorr.plausibility.alignment import TINY, distinct
from tofcorr.plausibility.finding import (
    CAMERA,
    MANY_FRAMES,
    WORTH_A_WORD,
    Finding,
    doubtful,
    in_words,
    note,
)
from tofcorr.plausibility.linear import LinearResiduals
from tofcorr.plausibility.look import Look

# F and the share of the sum of squares that a step must reach. At one moment: of 24 recordings of
# 20 or 40 frames, knocked by 8 mm and a degree, all had that, F from 17 and the share from 0.76 on;
# of 361 clean ones, or with another error, two had it.
_LEAST_AT_A_MOMENT = (15.0, 0.7)
# Of fewer than 20 frames, and of parts in any order, which are chosen to differ. Of 20 recordings
# of 14 to 19 frames, knocked by 8 mm and a degree, 18 had that, and none of 220 clean ones or with
# another error, whose F reached 29; of 24 of a tool frame 20 mm and 2 degrees away all had it; of
# 391 others none: the largest share was 0.88, of poses 12 mm late.
_LEAST_OTHERWISE = (50.0, 0.9)


Parts = tuple[np.ndarray, float, float]
"""Frames of one part, rising, as indices; how far a camera elsewhere in it moves points off their
planes, root mean square over the frames of the smaller part, metres; and the share of the sum of
squares that it explains."""


def remounting(look: Look) -> Iterator[Finding]:
    """Does the camera sit at one place on the tool, from some moment on or in any order?"""
    if look.linear is None or not look.scene.moves:
        return
    frames = look.frames[look.scene.known]
    poses, fewest = len(distinct(look.linear.scene.poses)), look.linear.frames_for(times=2)
    # A drift beyond what a camera makes explains what would be found.
    drifts = (look.drift is not None and look.drift.size > CAMERA) or poses < fewest
    mounting = None if drifts else Mounting(look.of_camera)
    if mounting is not None and (found := mounting.moment()):
        where = f"From frame {frames[found[0][0]]} on, or about there,"
        cause = "it was knocked or mounted anew, or poses and images are of different times"
        yield _moved(found, where, cause)
    elif mounting is not None and (found := mounting.parts()):
        cause = "some poses are of another frame of the robot, such as its flange"
        yield _moved(found, f"In {in_words(frames[found[0]].tolist())}", cause)
    elif (poses := len(distinct(look.scene.poses))) < MANY_FRAMES:
        unseen = f"some poses are of another frame of the robot ({MANY_FRAMES} are needed)"
        if poses < fewest:
            unseen = f"the camera moved on the tool ({fewest} are needed) or {unseen}"
        few = f"{poses} distinct poses are too few to see whether {unseen}."
        yield note(few, check="remounting")


def _moved(found: Parts, where: str, cause: str) -> Finding:
    _, size, share = found
    moved = f"{where} the points lie {1e3 * size:.0f} mm elsewhere, as if the camera had moved"
    said = f"{moved} on the tool (two hand-eye transforms explain {100 * share:.0f} % of what one"
    said = f"{said} leaves): {cause}; train the parts apart."
    return doubtful(said, spoils=True, check="remounting")


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
        scale = weight / max(float(np.median(weight)), TINY) / np.sqrt(count)
        twist = np.concatenate([problem.cosine[..., None], problem.rigid], axis=-1)
        across = scale[:, None, None] * problem.plane_directions
        columns, residual, step = (
            np.einsum("fpa,fpk->fak", across, part, optimize=True)[chosen]
            for part in (problem.columns, problem.residual[..., None], twist)
        )
        kept = _agreeing(columns, residual)
        self.frame, self.step, self._residual = chosen[kept], step[kept], residual[kept]
        # The smaller part must have a sixth of the frames, and six: six unknowns, three from each.
        # Smaller parts are single wrong poses.
        self._fewest = max(6, len(self.frame) // 6)
        self._basis = np.linalg.qr(_stacked(columns[kept]))[0]
        self._left = self._beside(_stacked(self._residual))[:, 0]

    def _beside(self, columns: np.ndarray) -> np.ndarray:
        """Return what the calibration's unknowns leave of columns (3 N, K)."""
        return columns - self._basis @ (self._basis.T @ columns)

    def _solved(self, columns: np.ndarray) -> tuple[np.ndarray, float]:
        """Return the unknowns of columns under their prior, and its weight.

        Without it, parts could disagree by metres in what they do not determine.
        """
        left, count = self._left, columns.shape[1]
        prior = max(float(left @ left) / len(left), TINY) / PRIOR_SIGMA**2
        held = np.concatenate([columns, math.sqrt(prior) * np.eye(count)])
        return np.linalg.lstsq(held, np.append(left, np.zeros(count)), rcond=None)[0], prior

    def _best(self, choices: Iterable[np.ndarray], least: tuple[float, float]) -> Parts | None:
        """Compare a step of the distances with one of the camera as well, for chosen frames (N,).

        Returns:
            The best choice, if it surely is a step of the camera and matters; else None.
        """
        best, parts = least[0], None
        for chosen in choices:
            columns = self._beside(_stacked(self.step * chosen[:, None, None]))
            constant, left = columns[:, :1], self._left
            before = left - constant @ np.linalg.lstsq(constant, left, rcond=None)[0]
            square = max(float(before @ before), TINY)
            unknowns, prior = self._solved(columns)
            now = left - columns @ unknowns
            gained = square - float(now @ now) - prior * float(unknowns @ unknowns)
            freedom = len(left) - self._basis.shape[1] - columns.shape[1]
            variance = max(float(now @ now) / max(freedom, 1), TINY)
            ratio = gained / (columns.shape[1] - 1) / variance
            smaller = max(min(int(chosen.sum()), int((~chosen).sum())), 1)
            size, share = math.sqrt(max(gained, 0.0) / smaller), gained / square
            if freedom > 0 and ratio > best:
                best = ratio
                sure = share > least[1] and size > WORTH_A_WORD
                parts = (self.frame[chosen], size, share) if sure else None
        return parts

    def moment(self) -> Parts | None:
        """Return the parts before and after one of some moments; None: the camera did not move."""
        number, least = len(self.frame), self._fewest
        if number < 2 * least:
            return None
        tried = np.unique(np.linspace(least, number - least, 41).astype(int))
        limits = _LEAST_OTHERWISE if number < MANY_FRAMES else _LEAST_AT_A_MOMENT
        return self._best((np.arange(number) >= moment for moment in tried), limits)

    def parts(self) -> Parts | None:
        """Return the two parts of the frames that differ most, in any order; None: none does.

        Which frames they are is not known: a few frames drawn at random fix a twist of the camera,
        those that agree best with one of many such twists are one part, and parts and twists are
        then improved in turn.
        """
        if len(self.frame) < MANY_FRAMES:
            return None
        improved = map(self._improved, self._starts())
        return self._best((one for one in improved if one is not None), _LEAST_OTHERWISE)

    def _starts(self) -> list[np.ndarray]:
        """Return halves of the frames, (N,) bool, that agree best with a twist of some frames.

        Three frames fix one: they have nine numbers, a constant and a twist seven. Of two parts of
        half the frames, one draw in four is of one part alone; of 20 recordings of 22 poses, the
        best 60 of 100 twists found the true parts in all.
        """
        number, size = len(self.frame), self.step.shape[-1]
        step = self.step / np.maximum(np.sqrt(np.square(self.step).mean(axis=(0, 1))), TINY)
        drawn = np.random.default_rng(number).random((100, number)).argsort(axis=1)[:, :3]
        columns = step[drawn].reshape(100, -1, size)
        matrix = columns.mT @ columns
        # A ten thousandth of the mean information: it only decides what three frames do not.
        ridge = np.trace(matrix, axis1=1, axis2=2) / 10_000
        matrix = matrix + ridge[:, None, None] * np.eye(size)
        right = columns.mT @ self._residual[drawn].reshape(100, -1, 1)
        twist = np.linalg.solve(matrix, right)[..., 0]
        explained = np.einsum("fak,sk->sfa", step, twist)
        off = np.square(self._residual[..., 0] - explained).sum(axis=2)
        agreeing = np.sort(off, axis=1)[:, : number // 2].sum(axis=1)
        return [one <= np.median(one) for one in off[np.argsort(agreeing)[:60]]]

    def _improved(self, chosen: np.ndarray) -> np.ndarray | None:
        """Put every frame to the part that explains it better, until none changes."""
        for _ in range(30):
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


def _agreeing(columns: np.ndarray, residual: np.ndarray) -> np.ndarray:
    """Return which frames (F,) do not, as single ones, disagree with all others.

    Frames with five times the median residual are left out, unless they are more than a tenth:
    then they may be a part by itself.
    """
    kept = np.ones(len(columns), dtype=bool)
    for _ in range(2):
        fitted = np.linalg.lstsq(_stacked(columns[kept]), _stacked(residual[kept]), rcond=None)[0]
        left = np.linalg.norm(residual - columns @ fitted, axis=(1, 2))
        kept = left < 5 * np.median(left)
    return kept if (~kept).sum() <= len(kept) / 10 else np.ones_like(kept)


def _stacked(parts: np.ndarray) -> np.ndarray:
    """Return (F, 3, K) as (3 F, K)."""
    return parts.reshape(-1, parts.shape[-1])
