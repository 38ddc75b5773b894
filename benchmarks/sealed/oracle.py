"""What can be found and closed at best: the base refitted with the true fields as columns.

The benchmarks' own fit by least squares, measured = geometry + error(geometry): Gauss-Newton on the
hand-eye, a cubic in distance, quadratics in row and column, a quadratic in amplitude, and whatever
further columns are given. Everything after the linearisation is sums of one small matrix per image.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from benchmarks.renewed.geometry import Array, small_motions
from benchmarks.renewed.recording import Data

FOLDS = 10
HALVINGS = 8  # of a step that leads out of the room
PLAUSIBLE_STEP = 0.05  # metres and radians: the accuracy of a hand-eye guess
FINDABLE = 2.0  # gain over its standard error from noise
HALF_COUNTED = 0.005  # metres of noise at which a report counts a pixel half in its gaps
ABSORBED = 1e-8  # a column with less than this share left after the base fit is not there


@dataclass(frozen=True)
class Oracle:
    """Held-out gaps over noise, before and after, and what can be found.

    `evidence` is the gain in squared error over the standard error that noise alone gives it. With
    t the effect's fitted coefficient over its standard error (leaving out images), the gain is t^2
    noise units and noise gives it the standard error 2 t: the ratio is t/2.
    """

    before_mm: float
    after_mm: float
    evidence: Mapping[str, float]

    def must_find(self, name: str) -> bool:
        """Whether a method that knew the form would find the effect with confidence."""
        return self.evidence[name] > FINDABLE

    @property
    def closed_fraction(self) -> float:
        """Share of the squared gap that is closed."""
        return 1 - (self.after_mm / self.before_mm) ** 2


class Moments(NamedTuple):
    """Per-image X'WX (N, P, P), X'Wt (N, P) and t'Wt (N,)."""

    gram: Array
    right: Array
    square: Array


@dataclass(frozen=True)
class Problem:
    """The linearised problem over the used pixels, in metres."""

    image: np.ndarray  # (M,) frame number of each pixel
    columns: Array  # (M, P)
    target: Array  # (M,) measured minus geometry
    weight: Array  # (M,)
    tool_from_camera: Array  # (4, 4)
    amplitude_unit: float  # what amplitudes are divided by

    def with_columns(self, *more: Array) -> "Problem":
        """The problem with further columns (M,)."""
        return replace(self, columns=np.column_stack([self.columns, *more]))

    def moments(self, target: Array, weight: Array) -> Moments:
        """Moments of the columns with a target and weights (M,)."""
        joint = np.column_stack([self.columns, target])
        scaled = joint * weight[:, None]
        bounds = [*np.flatnonzero(np.diff(self.image, prepend=-1)), len(target)]
        grams = np.stack([joint[a:b].T @ scaled[a:b] for a, b in pairwise(bounds)])
        return Moments(grams[:, :-1, :-1], grams[:, :-1, -1], grams[:, -1, -1])

    def fitted(self) -> Moments:
        """Moments of the weighted fit."""
        return self.moments(self.target, self.weight)

    @property
    def coefficients(self) -> Array:
        """Coefficients (P,) of the weighted fit."""
        fit = self.fitted()
        return solve(fit.gram.sum(0), fit.right.sum(0))


def ask(data: Data, fields: Mapping[str, Array], expected: Array) -> Oracle:
    """Ask the oracle; `fields` and `expected` (N, H, W) in metres are the sealed truth."""
    base, valid = linearise(data), data.valid
    problem = base.with_columns(*(field[valid] for field in fields.values()))
    noiseless = problem.target + (expected - data.depth)[valid]
    plain = base.columns.shape[1]
    coefficients, errors = jackknife(problem)
    fit = problem.fitted()
    t = coefficients[plain:] / np.maximum(errors[plain:], 1e-12)
    evidence = np.where(_left(fit, plain) > ABSORBED, t / 2, 0.0)
    score = problem.moments(noiseless, np.ones_like(noiseless))
    before, after = (
        1e3 * float(np.sqrt(held_out(fit, score, keep).sum() / len(noiseless)))
        for keep in (slice(plain), slice(None))
    )
    return Oracle(before, after, dict(zip(fields, evidence.tolist(), strict=True)))


def counted(sigma: Array) -> Array:
    """How much pixels of this noise (metres) count in the gaps of a report, 0 to 1."""
    return 1 / (1 + (sigma / HALF_COUNTED) ** 2)


def _left(fit: Moments, plain: int) -> Array:
    """Share of each added column's square that the other columns do not explain."""
    gram = fit.gram.sum(0)
    scale = np.sqrt(np.diag(gram))
    gram = gram / np.outer(scale, scale)
    shares = []
    for k in range(plain, len(gram)):
        others = np.delete(np.arange(len(gram)), k)
        explained = np.linalg.lstsq(gram[np.ix_(others, others)], gram[others, k], rcond=1e-12)[0]
        shares.append(1 - gram[k, others] @ explained)
    return np.array(shares)


def linearise(data: Data) -> Problem:
    """Fit hand-eye and base errors; return the problem at the solution."""
    problem = _problem(data, data.tool_from_camera)
    for _ in range(4 if data.moves else 0):
        problem = _stepped(data, problem, _step(problem))
    return problem


def at_other_poses(problem: Problem, data: Data) -> Problem:
    """The columns and targets of other data at the solution of a problem."""
    return _problem(data, problem.tool_from_camera, problem.amplitude_unit)


def _stepped(data: Data, problem: Problem, step: Array) -> Problem:
    """The problem after a step, halved while a target would come to lie behind the camera."""
    for _ in range(HALVINGS):
        hand_eye = problem.tool_from_camera @ small_motions(step[:3], step[3:])
        after = _problem(data, hand_eye)
        if len(after.target) >= len(problem.target):
            return after
        step = step / 2
    return problem


def _step(problem: Problem) -> Array:
    """The Gauss-Newton step (6,) of the hand-eye; what the poses leave free hardly moves."""
    fit = problem.fitted()
    gram, right = fit.gram.sum(0), fit.right.sum(0)
    free = np.arange(len(gram)) < 6
    noise = fit.square.sum() / len(problem.target)
    return solve(gram + np.diag(np.where(free, noise / PLAUSIBLE_STEP**2, 0.0)), right)[:6]


def solve(gram: Array, right: Array, size: Array | None = None) -> Array:
    """Coefficients (P,) of summed moments; columns may be collinear.

    `size` (P,), the diagonal of the moments of all images, tells which columns are as good as
    absent from these.
    """
    size = np.diag(gram) if size is None else size
    present = np.diag(gram) > 1e-9 * size
    scale = np.sqrt(np.diag(gram)[present])
    theta = np.zeros(len(gram))
    inner = gram[np.ix_(present, present)] / np.outer(scale, scale)
    theta[present] = np.linalg.lstsq(inner, right[present] / scale, rcond=1e-11)[0] / scale
    return theta


def held_out(fit: Moments, score: Moments, keep: slice) -> Array:
    """Held-out sums of squares (N,) in `score` of the columns `keep`, fitted to `fit`.

    Folds are of whole images.
    """
    gram, right = fit.gram[:, keep, keep], fit.right[:, keep]
    score_gram, score_right = score.gram[:, keep, keep], score.right[:, keep]
    total_gram, total_right = gram.sum(0), right.sum(0)
    losses = np.empty(len(gram))
    order = np.random.default_rng(0).permutation(len(gram))
    for fold in np.array_split(order, min(FOLDS, len(gram))):
        without = total_gram - gram[fold].sum(0), total_right - right[fold].sum(0)
        theta = solve(*without, np.diag(total_gram))
        explained = np.einsum("i,nij,j->n", theta, score_gram[fold], theta)
        losses[fold] = score.square[fold] - 2 * score_right[fold] @ theta + explained
    return losses


def jackknife(problem: Problem) -> tuple[Array, Array]:
    """Coefficients (P,) and their standard errors from leaving out one image at a time."""
    gram, right, _ = problem.fitted()
    total, sums = gram.sum(0), right.sum(0)
    pairs = zip(gram, right, strict=True)
    left = np.stack([solve(total - a, sums - b, np.diag(total)) for a, b in pairs])
    spread = ((left - left.mean(0)) ** 2).sum(0)
    return solve(total, sums), np.sqrt((len(left) - 1) / len(left) * spread)


def _problem(data: Data, hand_eye: Array, unit: float | None = None) -> Problem:
    camera = data.world_from_tool @ hand_eye
    turn, origin = camera[:, :3, :3], camera[:, :3, 3]
    normal = np.einsum("nij,ni->nj", turn, data.normal)  # in the camera frame
    slope = np.einsum("nj,hwj->nhw", normal, data.rays)
    distance = -((data.normal * origin).sum(-1) + data.offset)[:, None, None] / slope
    valid = data.valid & (distance > 0)
    image, row, column = np.nonzero(valid)
    d, s, ray, n = distance[valid], slope[valid], data.rays[row, column], normal[image]
    lever = d[:, None] * np.cross(ray, n)
    twist = np.column_stack([-n, -lever]) / s[:, None]
    c, r = 2 * column / data.rays.shape[1] - 1, 2 * row / data.rays.shape[0] - 1
    u = d - 1.25
    base = [np.ones_like(u), u, u**2, u**3, c, r, c**2, r**2]
    weight = np.ones_like(u)
    if data.amplitude is not None:
        unit = unit or float(np.median(data.amplitude[valid]))
        a = data.amplitude[valid] / unit
        base += [a, a**2]
        weight = np.minimum(a, np.quantile(a, 0.8))
    return Problem(
        image=image,
        columns=np.column_stack([twist, *base] if data.moves else base),
        target=data.depth[valid] - d,
        weight=weight / weight.mean(),
        tool_from_camera=hand_eye,
        amplitude_unit=unit or 1.0,
    )
