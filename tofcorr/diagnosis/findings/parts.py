"""All parts of the gap as given, fitted together, from sums over the poses."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from tofcorr.diagnosis.findings.causes import Cause, causes_of, twist_of
from tofcorr.diagnosis.findings.naming import NamedEffects
from tofcorr.diagnosis.sums.study import Study

# An effect that reproduces this share of a constant is taken to reproduce it: its own mean says
# nothing then, and counts as a constant. Chosen; a warm-up reaches 0.95, an offset 1.
_HOLDS_CONSTANT = 0.8
# Added to the diagonal of an effect's products, as a share of its mean, so that they are regular.
_RIDGE = 1e-6


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
    """

    causes: tuple[Cause, ...]
    products: Tensor
    means: Tensor
    counts: Tensor
    noise: Tensor
    start: Tensor
    fitted: tuple[Tensor, Tensor, Tensor]
    constant: int

    def refitted(self, weights: Tensor) -> tuple[Tensor, Tensor]:
        """Fit all parts together to some poses.

        Args:
            weights: How often each pose counts, shape (U,).

        Returns:
            Mean products of columns and residual, (Q, Q), and every cause's coefficients over the
            columns, (K, Q - 1).
        """
        count = (weights * self.counts).sum()
        products = torch.einsum("u,uij->ij", weights, self.products) / count
        means = (weights @ self.means)[:-1] / count
        gram, score, prior = self.fitted
        normal = torch.einsum("u,uij->ij", weights, gram) + prior
        theta = self.start + torch.linalg.solve(normal, weights @ score)
        coefficients = torch.zeros(len(self.causes), len(means), dtype=torch.float64)
        for row, cause in zip(coefficients, self.causes, strict=True):
            row[list(cause.members)] = theta[list(cause.members)]
            if cause.fixed is not None:
                row[cause.fixed] = 1.0
            if cause.centred:
                row[self.constant] -= row @ means
        centred = torch.tensor([cause.centred for cause in self.causes], dtype=torch.bool)
        taken = coefficients[centred, self.constant].sum()
        for row, cause in zip(coefficients, self.causes, strict=True):
            if self.constant in cause.members:
                row[self.constant] -= taken
        return products, coefficients


def parts_of(study: Study, named: NamedEffects, residual: Tensor | None) -> Parts:
    """Return the parts of the residual of a simulator as given.

    Args:
        study: The recording, before any effect was named.
        named: The effects named.
        residual: Of the simulator as given, shape (M,), metres; None: that of the base model, of
            which only effects are causes.
    """
    model, sums = study.fit.model, named.study.system.blocks.even
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
