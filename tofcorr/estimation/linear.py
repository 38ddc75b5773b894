r"""Linear least squares with the pose as the independent unit.

The residuals of a pose's pixels, :math:`r = r_0 + X \theta`, share the error of the pose and of its
target. So what the pixels say is summed over each pose, and everything follows from these sums of
products of the columns :math:`(X, r_0)`; no pixel is read again:

- `pose_products` forms them, and `NormalEquations` adds them up, with a prior;
- `solved` and `Curvature` solve them, scaled to a unit diagonal, with one cut for rounding;
- `left_out_steps` and `robust_covariance` leave one pose out at a time;
- `AddedColumns` tests columns beside those of a model, by leaving out poses as well;
- `without_effects` and `estimate` integrate out effects that each pose has of its own.

Unless it says otherwise, everything is float64, and no unit is asked for.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from tofcorr.errors import CalibrationDataError
from tofcorr.estimation.statistics import f_tail

RESOLVED = 1e-10
"""Share of the largest eigenvalue of a matrix of curvature, scaled to a unit diagonal, up to which
another is rounding. float64 resolves 1e-16, and sums of products over pixels lose some digits."""
# Share of a curvature that is added where it is the only one in its direction: without the one pose
# that determines it, or beside an effect that nothing determines. Well above rounding: such a
# direction scatters so much that nothing is concluded from it.
_RIDGE = 1e-9
# Share of its mean diagonal added to a matrix before it is factored: rounding of sums of products.
_ROUNDING = 1e-12
# Least curvature: equations of nothing but zeros have a solution, zero.
_TINY = 1e-300


def pose_products(
    columns: Float[Tensor, "M S"], pose: Int[Tensor, "M"], weight: Float[Tensor, "M"] | None = None
) -> Float[Tensor, "G S S"]:
    """Return the weighted sums of products of columns over the pixels of each pose.

    Args:
        columns: Of M pixels; the residual is usually the last.
        pose: Of each pixel, counted from zero.
        weight: Of each pixel, not negative; None: 1 each.
    """
    order = pose.argsort(stable=True)
    if weight is not None:
        columns = columns * weight.sqrt()[:, None]
    parts = columns[order].split(torch.bincount(pose).tolist())
    return torch.stack([own.T @ own for own in parts])


class NormalEquations(NamedTuple):
    """The quadratic model of a loss for a step d: loss + 2 g.d + d.H.d; of one unit, or of many.

    Attributes:
        loss: Sum of weighted squared residuals, shape (...).
        gradient: Half the gradient, shape (..., P).
        hessian: Half the Gauss-Newton Hessian, shape (..., P, P).
    """

    loss: Tensor
    gradient: Tensor
    hessian: Tensor

    def total(self) -> "NormalEquations":
        """Return the sum over the units."""
        return NormalEquations(*(part.sum(dim=0) for part in self))

    def by_pose(self, pose: Int[Tensor, "N"] | None) -> "NormalEquations":
        """Return the sums over the units (N,) of each pose; None: every unit is its own."""
        if pose is None:
            return self
        count = int(pose.max()) + 1
        parts = (part.new_zeros(count, *part.shape[1:]).index_add_(0, pose, part) for part in self)
        return NormalEquations(*parts)

    def plus(self, prior: "NormalEquations | None") -> "NormalEquations":
        """Return the equations with those of a prior on all unknowns, or on the first of them."""
        if prior is None:
            return self
        rest = self.gradient.shape[-1] - prior.gradient.shape[-1]
        pad = torch.nn.functional.pad
        return NormalEquations(
            self.loss + prior.loss,
            self.gradient + pad(prior.gradient, (0, rest)),
            self.hessian + pad(prior.hessian, (0, rest, 0, rest)),
        )

    def at(self, step: Float[Tensor, "P"]) -> "NormalEquations":
        """Return the same quadratic model for further steps after this one."""
        slope = self.hessian @ step
        loss = self.loss + 2 * self.gradient @ step + step @ slope
        return NormalEquations(loss, self.gradient + slope, self.hessian)

    @property
    def is_finite(self) -> bool:
        """Whether the loss and its curvature are."""
        return bool(torch.isfinite(self.loss).all() & self.hessian.isfinite().all())


def solved(
    matrix: Float[Tensor, "*B P P"], right: Float[Tensor, "*B P"], ridge: float = _ROUNDING
) -> Float[Tensor, "*B P"]:
    """Solve equations, each unknown scaled to its own curvature.

    Args:
        matrix: Symmetric, not negative.
        right: The right-hand side.
        ridge: Share of each curvature that is added to it, as Marquardt's damping is.
    """
    scale = matrix.diagonal(dim1=-2, dim2=-1).clamp(min=_TINY).rsqrt()
    unit = matrix * scale[..., :, None] * scale[..., None, :]
    damped = unit + ridge * torch.eye(unit.shape[-1]).to(unit)
    return scale * torch.linalg.solve(damped, (right * scale)[..., None])[..., 0]


def inverse(matrix: Float[Tensor, "P P"]) -> Float[Tensor, "P P"]:
    """Return the inverse of a positive definite matrix, scaled to a unit diagonal before."""
    scale = matrix.diagonal().clamp(min=_TINY).rsqrt()
    unit = matrix * scale[:, None] * scale + _ROUNDING * torch.eye(len(scale)).to(matrix)
    return torch.cholesky_inverse(torch.linalg.cholesky(unit)) * scale[:, None] * scale


class Curvature:
    """A symmetric matrix that is not negative, or a batch of them, factored without its rounding.

    Attributes:
        scale: Factors that make its diagonal 1, shape (..., P).
        values: Eigenvalues of the matrix scaled by them, ascending, shape (..., P).
        vectors: Their eigenvectors, in the columns, shape (..., P, P).
        resolved: Which of them are more than rounding, shape (..., P).
        basis: B, shape (..., P, P), with B^T H B = 1 in every resolved direction; a column of zeros
            stands for each of the others.
    """

    def __init__(self, matrix: Float[Tensor, "*B P P"]) -> None:
        self.scale = matrix.diagonal(dim1=-2, dim2=-1).clamp(min=_TINY).rsqrt()
        unit = matrix * self.scale[..., :, None] * self.scale[..., None, :]
        self.values, self.vectors = torch.linalg.eigh(unit)
        self.resolved: Bool[Tensor, "*B P"] = self.values > RESOLVED * self._largest
        kept = torch.where(self.resolved, self.values, torch.inf).rsqrt()
        self.basis = self.scale[..., :, None] * self.vectors * kept[..., None, :]

    @property
    def _largest(self) -> Float[Tensor, "*B P"]:
        return self.values.amax(dim=-1, keepdim=True).expand(self.values.shape)

    @property
    def inverse(self) -> Float[Tensor, "*B P P"]:
        """The pseudo-inverse: zero in the directions that are rounding."""
        return self.basis @ self.basis.mT

    @property
    def matrix(self) -> Float[Tensor, "*B P P"]:
        """The matrix without rounding: exactly singular where that was all."""
        root = self.vectors * torch.where(self.resolved, self.values, 0.0).sqrt()[..., None, :]
        root = root / self.scale[..., :, None]
        return root @ root.mT

    @property
    def condition(self) -> float:
        """Condition number of one scaled matrix, rounding and all."""
        return float(self.values.max() / self.values.min().clamp(min=_TINY))


def left_out_steps(
    each: NormalEquations, hessian: Float[Tensor, "P P"]
) -> tuple[Float[Tensor, "G P"], Curvature]:
    """Return how far the least squares solution moves without each pose, by one step each.

    Args:
        each: The equations of the poses, at the solution: with the prior's they sum to zero.
        hessian: The curvature of all poses and of the prior.

    Returns:
        The steps, none of them along a direction that is rounding, and the factored curvature.
    """
    whole = Curvature(hessian)
    solve = _without_each(whole, each.hessian)
    return (solve @ (each.gradient @ whole.basis)[..., None])[..., 0] @ whole.basis.T, whole


def _without_each(whole: Curvature, each: Float[Tensor, "G P P"]) -> Float[Tensor, "G P P"]:
    """Return the inverse curvature without each pose, in the coordinates of the whole's basis."""
    one = torch.eye(each.shape[-1]).to(each)
    return torch.linalg.inv((1 + _RIDGE) * one - whole.basis.T @ each @ whole.basis)


def robust_covariance(left_out: Float[Tensor, "G P"]) -> Float[Tensor, "P P"]:
    """Return the covariance that the solutions without each pose give.

    It is the cluster-robust CRV3 estimator (Bell and McCaffrey 2002; MacKinnon, Nielsen and Webb
    2023), whose intervals keep about their nominal coverage with few poses.
    """
    centred = left_out - left_out.mean(dim=0)
    return (len(left_out) - 1) / len(left_out) * centred.T @ centred


class Added(NamedTuple):
    """What columns say that are added to a model.

    Attributes:
        values: Estimates of their unknowns, shape (F,).
        p_value: Probability of as large values by chance if the true ones are zero.
        shift: How far the unknowns of the model move, shape (P,).
    """

    values: Tensor
    p_value: float
    shift: Tensor


class AddedColumns:
    r"""Least squares of a model of P unknowns, to be compared with that of P + F.

    Residuals :math:`r = X \theta + Z \gamma` are minimised twice, with Z and without. The poses
    decide whether :math:`\gamma` is there: they are left out one at a time.

    Args:
        products: Of the columns of each pose, in the order: X, all further columns, the residual;
            shape (G, S, S).
        prior: On the P unknowns of X, in the unit of the products.
    """

    # Share of an added column that the model must leave for it to be looked at: far above the
    # rounding of sums of products.
    _LEAST_LEFT = 1e-6

    def __init__(self, products: Float[Tensor, "G S S"], prior: NormalEquations) -> None:
        unknowns = len(prior.gradient)
        own = products[:, :unknowns, :unknowns]
        whole = Curvature(own.sum(dim=0) + prior.hessian)
        self._basis = whole.basis
        self._cross = self._basis.T @ products[:, :unknowns, unknowns:]
        self._whole = self._cross.sum(dim=0)
        self._whole[:, -1] += self._basis.T @ prior.gradient
        self._products = products[:, unknowns:, unknowns:]
        self._inverse = _without_each(whole, own)

    def __call__(self, chosen: list[int]) -> Added | None:
        """Estimate the unknowns of some of the further columns as well.

        Args:
            chosen: Their places among all further columns.

        Returns:
            None where the model leaves nothing of a column, or where there are too few poses.
        """
        count, number = len(self._products), len(chosen)
        places = [*chosen, self._products.shape[-1] - 1]
        products = self._products[:, places][:, :, places]
        cross, whole = self._cross[:, :, places], self._whole[:, places]
        total = products.sum(dim=0)
        left = total - whole.T @ whole
        least = self._LEAST_LEFT * total.diagonal()
        if count <= number + 1 or bool((left.diagonal() < least)[:-1].any()):
            return None
        others = whole - cross
        values = _last_eliminated(left)
        without = _last_eliminated(total - products - others.mT @ self._inverse @ others)
        # Hotelling's T^2: as F, with the poses less one as degrees of freedom.
        square = values @ Curvature(robust_covariance(without)).inverse @ values
        freedom = count - number
        ratio = float(square) * freedom / (number * (count - 1))
        shift = -self._basis @ (whole[:, :-1] @ values)
        return Added(values, f_tail(ratio, number, freedom), shift)


def _last_eliminated(products: Float[Tensor, "*B S S"]) -> Float[Tensor, "*B F"]:
    """Return the unknowns of least squares from products of the columns and of the residual."""
    right = products[..., :-1, -1:]
    return -(Curvature(products[..., :-1, :-1]).inverse @ right)[..., 0]


@contextmanager
def solvable(
    path: Path,
    task: str,
    reason: str = "the frames do not differ enough, or poses, planes or depth are far off; see "
    "`tofcorr inspect`.",
) -> Iterator[None]:
    """Refuse a recording whose equations the block finds to have no solution.

    Args:
        path: Of the recording.
        task: What solves them: the fit, for example.
        reason: Why there may be no solution, and what to do.

    Raises:
        CalibrationDataError: A matrix of the block is singular.
    """
    try:
        yield
    except torch.linalg.LinAlgError:  # pyright: ignore[reportPrivateImportUsage] - documented
        raise CalibrationDataError(
            f"{path}: the equations of the {task} have no solution: {reason}"
        ) from None
