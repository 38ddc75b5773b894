"""All parts of the gap as given, fitted together, from sums over the poses."""

from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from tofcorr.diagnosis.findings.causes import Cause, causes_of, twist_of
from tofcorr.diagnosis.findings.naming import NamedEffects
from tofcorr.diagnosis.findings.naming_rules import least_of_further
from tofcorr.diagnosis.findings.unchanged import held_solution, unchanged
from tofcorr.diagnosis.sums.study import Study

# An effect that reproduces this share of a constant is taken to reproduce it: its own mean says
# nothing then, and counts as a constant. Chosen; a warm-up reaches 0.95, an offset 1.
_HOLDS_CONSTANT = 0.8
# Added to the diagonal of an effect's products, as a share of its mean, so that they are regular.
_RIDGE = 1e-6


class Reading(NamedTuple):
    """How the parts are told from one another where the data leave a choice.

    Attributes:
        sparse: Parameters of the simulator stay as they are unless the data require a change.
        constants_to_base: An effect that can describe a constant gives it to the base model, if
            the base model's constant changes at all.
    """

    sparse: bool
    constants_to_base: bool


PREFERRED = Reading(sparse=True, constants_to_base=True)
"""The reading that is reported."""
FREE = Reading(sparse=False, constants_to_base=True)
"""Everything fitted together: explains most."""
READINGS = (PREFERRED, FREE, Reading(sparse=True, constants_to_base=False))
"""All readings that the data allow; intervals cover them."""


@dataclass(frozen=True, kw_only=True)
class Parts:
    """Columns of all causes and their sums over each pose.

    Attributes:
        causes: The causes whose shares are wanted.
        products: Of all columns and, in the last place, of the residual, every pixel counting
            alike, shape (U, Q, Q), m^2. Columns that are fitted come first, then those with the
            coefficient one.
        means: Sum of each column over a pose, shape (U, Q), metres.
        counts: Pixels of each pose, shape (U,).
        noise: Sum of the variances of a pose's pixels, shape (U,), m^2.
        start: Coefficients of the fitted columns that lead from the simulator to the base fit.
        fitted: A_u, b_u and the prior precision of what the final model adds to them.
        constant: Number of the constant's column.
        least: What a parameter's change must close for each pose, in the unit of `fitted`, (U,).
    """

    causes: tuple[Cause, ...]
    products: Tensor
    means: Tensor
    counts: Tensor
    noise: Tensor
    start: Tensor
    fitted: tuple[Tensor, Tensor, Tensor]
    constant: int
    least: Tensor

    def refitted(self, weights: Tensor, reading: Reading = FREE) -> tuple[Tensor, Tensor]:
        """Fit all parts together to some poses.

        Args:
            weights: How often each pose counts, shape (U,).
            reading: Which of the fits that the data allow.

        Returns:
            Mean products of columns and residual, (Q, Q), and every cause's coefficients over the
            columns, (K, Q - 1).
        """
        count = (weights * self.counts).sum()
        products = torch.einsum("u,uij->ij", weights, self.products) / count
        means = (weights @ self.means)[:-1] / count
        theta, held = self._solved(weights, sparse=reading.sparse)
        to_base = reading.constants_to_base and not any(
            self.constant in cause.members for cause in self.causes if cause.name in held
        )
        coefficients = torch.zeros(len(self.causes), len(means), dtype=torch.float64)
        moved = torch.tensor(0.0, dtype=torch.float64)
        for row, cause in zip(coefficients, self.causes, strict=True):
            row[list(cause.members)] = theta[list(cause.members)]
            if cause.fixed is not None and cause.name not in held:
                row[cause.fixed] = 1.0
            if cause.centred and (to_base or cause.kind != "effect"):
                mean = row @ means
                row[self.constant] -= mean
                moved += mean
        for row, cause in zip(coefficients, self.causes, strict=True):
            if self.constant in cause.members:
                row[self.constant] += moved
        return products, coefficients

    def _solved(self, weights: Tensor, *, sparse: bool) -> tuple[Tensor, frozenset[str]]:
        """Return the coefficients of the fitted columns, and the parameters left unchanged."""
        gram, score, prior = self.fitted
        normal = torch.einsum("u,uij->ij", weights, gram) + prior
        right = weights @ score
        groups = {c.name: c.members for c in self.causes if c.kind == "parameter" and c.members}
        held: frozenset[str] = frozenset()
        if sparse:
            least = float(weights @ self.least)
            held = unchanged(normal, right, self.start, groups, least)
        columns = [column for name in held for column in groups[name]]
        return held_solution(normal, right, self.start, columns), held


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
    columns = named.study.system.columns[:, members]
    causes = causes_of(study, named, parameters=residual is not None)
    start = torch.zeros(len(members), dtype=torch.float64)
    if residual is None:
        residual = study.system.residual
    else:
        start[: model.num_hand_eye] = twist_of(study)
        start[model.num_geometry : model.num_columns] = study.fit.coefficients
    kept: list[Tensor] = []
    for place, cause in enumerate(causes):
        if cause.offset is not None:
            causes[place] = replace(cause, fixed=len(members) + len(kept))
            kept.append(cause.offset[:, None])
    products, means, counts = _sums(study, torch.cat([columns, *kept, residual[:, None]], dim=1))
    share, inner = means.sum(0) / counts.sum(), products.sum(0) / counts.sum()
    return Parts(
        causes=tuple(
            replace(cause, centred=cause.centred or _holds_constant(cause, share, inner))
            for cause in causes
        ),
        products=products,
        means=means,
        counts=counts,
        noise=torch.zeros_like(counts).index_add(
            0, study.unit_of_pixel, study.fit.trust * study.fit.sigma**2
        ),
        start=start,
        fitted=sums.of(named.columns),
        constant=model.num_geometry,
        least=least_of_further(study) * blocks.even_scale * blocks.count,
    )


def _holds_constant(cause: Cause, means: Tensor, inner: Tensor) -> bool:
    """Return whether an effect can describe a constant, so that its own mean says nothing."""
    if cause.kind != "effect" or not cause.members:
        return False
    own = torch.tensor(cause.members)
    gram = inner[own][:, own]
    gram = gram + _RIDGE * gram.diagonal().mean() * torch.eye(len(own), dtype=torch.float64)
    return float(means[own] @ torch.linalg.solve(gram, means[own])) > _HOLDS_CONSTANT


def _sums(study: Study, everything: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return products of all columns, their sums, and the pixels of each pose."""
    units, size = study.system.blocks.num_units, everything.shape[1]
    products = torch.zeros(units, size, size, dtype=torch.float64)
    means = torch.zeros(units, size, dtype=torch.float64)
    counts = torch.zeros(units, dtype=torch.float64)
    for frame, (start, end) in enumerate(study.observations.frame_ends):
        own, trust = everything[start:end], study.fit.trust[start:end]
        unit = int(study.observations.unit[frame])
        products[unit] += own.T @ (own * trust[:, None])
        means[unit] += trust @ own
        counts[unit] += trust.sum()
    return products, means, counts
