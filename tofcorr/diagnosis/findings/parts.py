"""All parts of the gap as given, fitted together, from sums over the poses.

A wall at an unknown place cannot tell whose a constant is: that of the camera, of a shift along its
axis, or the mean of an effect. So the mean of every part over all pixels counts as `distance`, and
all other parts have mean zero. The constant itself is then the mean of the residual, which needs no
model.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from tofcorr.diagnosis.findings.causes import HAND_EYE, Cause, causes_of, twist_of
from tofcorr.diagnosis.findings.naming import NamedEffects
from tofcorr.diagnosis.findings.naming_rules import least_of_hand_eye
from tofcorr.diagnosis.findings.unchanged import held_solution, unchanged
from tofcorr.diagnosis.sums.study import Study

# A base term changes only if that closes this, metres. Chosen: what no one calls a gap. The
# hand-eye transform needs as much as a second effect: it resembles most what models miss.
_LEAST_OF_TERM = 1e-4


@dataclass(frozen=True, kw_only=True)
class Parts:
    """Columns of all causes and their sums over each pose.

    Attributes:
        causes: The causes whose shares are wanted.
        products: Of all columns and, in the last place, of the residual, with every pixel counting
            as it does in the gap that is shared out, shape (U, Q, Q), m^2. Columns that are fitted
            come first, then those with the coefficient one.
        means: Sum of each column over a pose, shape (U, Q), metres.
        counts: Pixels of each pose, shape (U,).
        noise: Sum of the variances of a pose's pixels, shape (U,), m^2.
        start: Coefficients of the fitted columns that lead from the simulator to the base fit.
        fitted: A_u, b_u and the prior precision of what the final model adds to them.
        prior: That precision in the unit of `products`, m^2.
        constant: Number of the constant's column.
        least: What a change of each parameter must close for each pose, in the unit of `fitted`,
            (U,).
    """

    causes: tuple[Cause, ...]
    products: Tensor
    means: Tensor
    counts: Tensor
    noise: Tensor
    start: Tensor
    fitted: tuple[Tensor, Tensor, Tensor]
    prior: Tensor
    constant: int
    least: dict[str, Tensor]

    def refitted(self, weights: Tensor, *, sparse: bool = False) -> "Refitted":
        """Fit all parts together to some poses.

        Args:
            weights: How often each pose counts, shape (U,).
            sparse: Whether parameters of the simulator stay as they are unless the data require a
                change.
        """
        count = (weights * self.counts).sum()
        products = torch.tensordot(weights, self.products, dims=1) / count
        means = (weights @ self.means) / count
        gram, score, prior = self.fitted
        normal = torch.tensordot(weights, gram, dims=1) + prior
        theta, held = self._solved(normal, weights @ score, weights, sparse=sparse)
        coefficients = torch.zeros(len(self.causes), len(means) - 1, dtype=torch.float64)
        coefficients[:, : len(theta)] = self._owned * theta
        for row, cause in zip(coefficients, self.causes, strict=True):
            if cause.fixed is not None and cause.name not in held:
                row[cause.fixed] = 1.0
        owner = [self.constant in cause.members for cause in self.causes]
        if any(owner):
            mean = coefficients @ means[:-1]
            mean[owner.index(True)] -= mean.sum()
            coefficients[:, self.constant] -= mean
        else:
            self._absorb(coefficients, normal)
        return Refitted(products=products, means=means, coefficients=coefficients)

    @cached_property
    def _owned(self) -> Tensor:
        """One where a fitted column belongs to a cause, else zero, (causes, columns)."""
        owned = torch.zeros(len(self.causes), len(self.start), dtype=torch.float64)
        for row, cause in zip(owned, self.causes, strict=True):
            row[list(cause.members)] = 1.0
        return owned

    @cached_property
    def base(self) -> list[int]:
        """Numbers of the fitted columns that belong to no cause."""
        return (self._owned.sum(0) == 0).nonzero()[:, 0].tolist()

    def _absorb(self, coefficients: Tensor, normal: Tensor) -> None:
        """Refit the base model to each part: what it takes up is no part of what it leaves."""
        base = self.base
        parts = coefficients[:, : len(normal)]
        parts[:, base] = -torch.linalg.solve(normal[base][:, base], normal[base] @ parts.T).T

    def _solved(
        self, normal: Tensor, right: Tensor, weights: Tensor, *, sparse: bool
    ) -> tuple[Tensor, frozenset[str]]:
        """Return the coefficients of the fitted columns, and the parameters left unchanged."""
        groups = {c.name: c.members for c in self.causes if c.name in self.least and c.members}
        held: frozenset[str] = frozenset()
        if sparse:
            least = {name: float(weights @ self.least[name]) for name in groups}
            held = unchanged(normal, right, self.start, groups, least)
        columns = [column for name in held for column in groups[name]]
        return held_solution(normal, right, self.start, columns), held


@dataclass(frozen=True, kw_only=True)
class Refitted:
    """All parts, fitted to some poses.

    Attributes:
        products: Mean products of columns and, in the last place, of the residual, (Q, Q), m^2.
        means: Their means, shape (Q,), metres.
        coefficients: Of every part over the columns, shape (K, Q - 1).
    """

    products: Tensor
    means: Tensor
    coefficients: Tensor

    @property
    def values(self) -> Tensor:
        """Shapley value of each part in the fall of the square, shape (K,), m^2."""
        return shapley_values(self.products, self.coefficients)

    @property
    def constant(self) -> float:
        """What a constant over all pixels contributes to the value of the part that has it, m^2."""
        mean = self.coefficients.sum(0) @ self.means[:-1]
        return float(mean * (2 * self.means[-1] - mean))


def shapley_values(gram: Tensor, coefficients: Tensor) -> Tensor:
    r"""Return the Shapley value of each part in the fall of the square, shape (K,).

    Args:
        gram: Inner products of the columns and, in the last place, of the residual, (Q, Q).
        coefficients: Of every part over the columns, shape (K, Q - 1).
    """
    whole = coefficients.sum(0)
    # g_k . (r + e), with e = r - sum of all parts.
    return coefficients @ (2 * gram[:-1, -1] - gram[:-1, :-1] @ whole)


def parts_of(study: Study, named: NamedEffects, residual: Tensor | None) -> Parts:
    """Return the parts of the residual of a simulator as given.

    Args:
        study: The recording, before any effect was named.
        named: The effects named.
        residual: Of the simulator as given, shape (M,), metres; None: that of the base model, of
            which only effects are causes.
    """
    model, blocks = study.fit.model, named.study.system.blocks
    sums = blocks.even
    members = sums.layout.of(named.columns)
    columns = named.study.system.columns.of(named.columns)
    causes = causes_of(study, named, parameters=residual is not None)
    start = torch.zeros(len(members), dtype=torch.float64)
    # The gap as given is of all pixels alike; after recalibration noisy ones count less.
    weight = study.fit.trust
    if residual is None:
        residual, weight = study.system.residual, study.fit.share
    else:
        start[: model.num_hand_eye] = twist_of(study)
        start[model.num_geometry : model.num_columns] = study.fit.coefficients
    kept: list[Tensor] = []
    for place, cause in enumerate(causes):
        if cause.offset is not None:
            causes[place] = replace(cause, fixed=len(members) + len(kept))
            kept.append(cause.offset[:, None])
    fitted = sums.of(named.columns)
    products, means, counts = _sums(study, [*columns, *kept, residual[:, None]], weight)
    second = least_of_hand_eye(study)
    term = min(second, _LEAST_OF_TERM**2)
    pose = blocks.even_scale * blocks.count
    return Parts(
        causes=tuple(causes),
        products=products,
        means=means,
        counts=counts,
        noise=torch.zeros_like(counts).index_add(
            0, study.unit_of_pixel, weight * study.fit.sigma**2
        ),
        start=start,
        fitted=fitted,
        prior=fitted[2] / blocks.even_scale,
        constant=model.num_geometry,
        least={
            cause.name: pose * (second if cause.name == HAND_EYE else term)
            for cause in causes
            if cause.kind == "parameter"
        },
    )


def _sums(study: Study, parts: Sequence[Tensor], weight: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return products of all columns, their sums, and the pixels of each pose; `weight` (M,)."""
    everything = torch.cat([*parts, torch.ones_like(parts[-1])], dim=1)
    sums = study.observations.products(everything, everything * weight[:, None])
    return sums[:, :-1, :-1], sums[:, :-1, -1], sums[:, -1, -1]
