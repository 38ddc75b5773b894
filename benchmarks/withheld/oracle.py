"""What can be found and closed at best: the base refitted with the true fields as columns."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from benchmarks.withheld.fitting import Moments, held_out, jackknife, linearise, moments
from benchmarks.withheld.generator.rigid import Array
from benchmarks.withheld.reading import Data

FINDABLE = 2.0  # gain over its standard error from noise
HALF_COUNTED = 0.005  # metres of noise at which a report counts a pixel half in its gaps
ABSORBED = 1e-8  # a column with less than this share left after the base fit is not there


@dataclass(frozen=True)
class Gap:
    """Held-out gaps over noise, before and after; per effect, what leaving it out again costs."""

    before_mm: float
    after_mm: float
    closes_mm: Mapping[str, float]

    @property
    def closed_fraction(self) -> float:
        """Share of the squared gap that is closed."""
        return 1 - (self.after_mm / self.before_mm) ** 2

    @property
    def shrinkage_mm(self) -> float:
        """Millimetres by which the gap shrinks."""
        return self.before_mm - self.after_mm


@dataclass(frozen=True)
class Oracle:
    """The gap with equal pixels and with pixels weighted by amplitude, and what can be found.

    `counted` is the gap of pixels that count as much as a report says they do; None: not asked for.

    `evidence` is the gain in squared error over the standard error that noise alone gives it. With
    t the effect's fitted coefficient over its standard error (leaving out images), the gain is t^2
    noise units and noise gives it the standard error 2 t: the ratio is t/2. `left` is the share of
    the effect's square that the base fit does not absorb.
    """

    plain: Gap
    weighted: Gap
    evidence: Mapping[str, float]
    left: Mapping[str, float]
    counted: Gap | None = None

    def must_find(self, name: str) -> bool:
        """Whether a method that knew the form would find the effect with confidence."""
        return self.evidence[name] > FINDABLE


def ask(
    data: Data, fields: Mapping[str, Array], expected: Array, count: Array | None = None
) -> Oracle:
    """Ask the oracle; `fields` and `expected` (N, H, W) in metres are the sealed truth.

    `count` (N, H, W) is how much each pixel counts in a gap; None: that gap is not asked for.
    """
    base, valid, names = linearise(data), data.valid, list(fields)
    added = (
        np.column_stack([fields[name][valid] for name in names])
        if names
        else np.empty((valid.sum(), 0))
    )
    problem = replace(base, columns=np.column_stack([base.columns, added]))
    noiseless = problem.target + (expected - data.depth)[valid]
    plain = base.columns.shape[1]
    coefficients, errors = jackknife(problem)
    fit = moments(problem, problem.target, problem.weight)
    left = _left(fit, plain)
    t = coefficients[plain:] / np.maximum(errors[plain:], 1e-12)
    evidence = np.where(left > ABSORBED, t / 2, 0.0)
    equal, weight = np.ones_like(noiseless), problem.weight
    counted = None
    if count is not None:
        own = count[valid]
        counted = _gap(fit, moments(problem, noiseless, own), own.sum(), plain, names)
    return Oracle(
        counted=counted,
        plain=_gap(fit, moments(problem, noiseless, equal), equal.sum(), plain, names),
        weighted=_gap(fit, moments(problem, noiseless, weight), weight.sum(), plain, names),
        evidence=dict(zip(names, evidence.tolist(), strict=True)),
        left=dict(zip(names, left.tolist(), strict=True)),
    )


def counted(sigma: Array) -> Array:
    """How much pixels of this noise (metres) count in the gaps of a report, 0 to 1."""
    return 1 / (1 + (sigma / HALF_COUNTED) ** 2)


def _gap(fit: Moments, noiseless: Moments, share: float, plain: int, names: list[str]) -> Gap:
    """Gaps of the fit to noisy data against the distances without noise."""
    every = np.arange(fit.gram.shape[1])

    def gap(keep: np.ndarray) -> float:
        return 1e3 * float(np.sqrt(held_out(fit, noiseless, keep).sum() / share))

    after = gap(every)
    closes = {name: gap(np.delete(every, plain + k)) - after for k, name in enumerate(names)}
    return Gap(gap(every[:plain]), after, closes)


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
