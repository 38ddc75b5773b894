r"""Linear least squares with the pose as the independent unit.

The residuals of a pose's pixels, :math:`r = r_0 + X \theta`, share the error of the pose and of its
target. So what the pixels say is summed over each pose, and everything follows from these sums of
products of the columns :math:`(X, r_0)`; no pixel is read again:

- `pose_products` forms them, and `NormalEquations` adds them up, with a prior;
- `solved` and `Curvature` solve them, scaled to a unit diagonal, with one cut for rounding;
- `left_out_steps` and `robust_covariance` leave one pose out at a time, `unbiased_covariance` for
  many unknowns;
- `AddedColumns` tests columns beside those of a model, by leaving out poses as well;
- `reduced` integrates out effects that each pose (here a group) has of its own: data are then
  :math:`y_g = X_g \beta + N_g u_g + \epsilon_g`, with :math:`u_g \sim N(0, T)`,
  :math:`\epsilon \sim N(0, \sigma^2 / w)` and a Gaussian prior on :math:`\beta`; `estimate` finds
  the variances too.

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
from tofcorr.estimation.robust import f_tail

RESOLVED = 1e-10
"""Share of the largest eigenvalue of a matrix of curvature, scaled to a unit diagonal, up to which
another is rounding. float64 resolves 1e-16, and sums of products over pixels lose some digits."""
ROUNDING = 1e-12
"""Share of a scaled curvature below which float64 resolves no direction of a single matrix; what is
added before one is factored."""
# Largest variance of an effect or of a prior, square metres or radians: 50 mm or mrad. Chosen: what
# is larger is no error of a camera or a robot, but two effects of opposite signs.
_LARGEST_VARIANCE = 0.05**2
# Least curvature: equations of nothing but zeros have a solution, zero.
_TINY = torch.finfo(torch.float64).tiny


def pose_products(
    columns: Float[Tensor, "M S"], pose: Int[Tensor, "M"], weight: Float[Tensor, "M"]
) -> Float[Tensor, "G S S"]:
    """Return the weighted sums of products of columns over the pixels of each pose.

    Args:
        columns: Of M pixels; the residual is usually the last.
        pose: Of each pixel, counted from zero.
        weight: Of each pixel, not negative.
    """
    columns = (columns * weight.sqrt()[:, None])[pose.argsort(stable=True)]
    parts = columns.split(torch.bincount(pose).tolist())
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

    def of(self, units: Tensor) -> "NormalEquations":
        """Return those of some units, given as a mask or by number."""
        return NormalEquations(*(part[units] for part in self))

    def by_pose(self, pose: Int[Tensor, "N"] | None) -> "NormalEquations":
        """Return the sums over the units (N,) of each pose; None: every unit is its own."""
        if pose is None:
            return self
        once = torch.nn.functional.one_hot(pose).T.to(self.loss)
        return NormalEquations(*(torch.tensordot(once, part, dims=1) for part in self))

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
    matrix: Float[Tensor, "*B P P"], right: Float[Tensor, "*B P"], ridge: float = ROUNDING
) -> Float[Tensor, "*B P"]:
    """Solve equations, each unknown scaled to its own curvature.

    Args:
        matrix: Symmetric, not negative.
        right: The right-hand side.
        ridge: Share of each curvature that is added to it, as Marquardt's damping is.
    """
    scale, unit = _scaled(matrix)
    damped = unit + ridge * torch.eye(unit.shape[-1]).to(unit)
    return scale * torch.linalg.solve(damped, (right * scale)[..., None])[..., 0]


def inverse(matrix: Float[Tensor, "*B P P"]) -> Float[Tensor, "*B P P"]:
    """Return the inverse of a positive definite matrix, scaled to a unit diagonal before."""
    scale, unit = _scaled(matrix)
    factor = torch.linalg.cholesky(unit + ROUNDING * torch.eye(unit.shape[-1]).to(unit))
    return torch.cholesky_inverse(factor) * scale[..., :, None] * scale[..., None, :]


def _scaled(
    matrix: Float[Tensor, "*B P P"],
) -> tuple[Float[Tensor, "*B P"], Float[Tensor, "*B P P"]]:
    """Return factors of the unknowns, and the matrix that they give a unit diagonal."""
    scale = matrix.diagonal(dim1=-2, dim2=-1).clamp(min=_TINY).rsqrt()
    return scale, matrix * scale[..., :, None] * scale[..., None, :]


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
        self.scale, unit = _scaled(matrix)
        self.values, self.vectors = torch.linalg.eigh(unit)
        largest = self.values.amax(dim=-1, keepdim=True)
        self.resolved: Bool[Tensor, "*B P"] = self.values > RESOLVED * largest
        kept = torch.where(self.resolved, self.values, torch.inf).rsqrt()
        self.basis = self.scale[..., :, None] * self.vectors * kept[..., None, :]

    @property
    def inverse(self) -> Float[Tensor, "*B P P"]:
        """The pseudo-inverse: zero in the directions that are rounding."""
        return self.basis @ self.basis.mT

    @property
    def root(self) -> Float[Tensor, "*B P P"]:
        """F with F F^T the matrix without rounding: exactly singular where that was all."""
        root = self.vectors * torch.where(self.resolved, self.values, 0.0).sqrt()[..., None, :]
        return root / self.scale[..., :, None]


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
    return torch.linalg.inv(_others(whole, each))


def _others(whole: Curvature, each: Float[Tensor, "G P P"]) -> Float[Tensor, "G P P"]:
    """Return the curvature without each pose, in the coordinates of the whole's basis."""
    # A share well above rounding is added: a direction that one pose alone determines then scatters
    # so much without it that nothing is concluded from it.
    one = torch.eye(each.shape[-1]).to(each)
    return (1 + 10 * RESOLVED) * one - whole.basis.T @ each @ whole.basis


def robust_covariance(left_out: Float[Tensor, "G P"]) -> Float[Tensor, "P P"]:
    """Return the covariance that the solutions without each pose give.

    It is the cluster-robust CRV3 estimator (Bell and McCaffrey 2002; MacKinnon, Nielsen and Webb
    2023), whose intervals keep about their nominal coverage with few poses.
    """
    centred = left_out - left_out.mean(dim=0)
    return (len(left_out) - 1) / len(left_out) * centred.T @ centred


def unbiased_covariance(each: NormalEquations, whole: Curvature) -> Float[Tensor, "P P"]:
    """Return the covariance of a solution with many unknowns for its poses.

    A solution without one pose is off too far, by one over the share of the curvature that the
    other poses have; this takes the root of it, so that the covariance is right on average where
    poses scatter alike: the estimator CRV2 (Bell and McCaffrey 2002).

    Args:
        each: The equations of the poses, at the solution.
        whole: The curvature of all poses and of the prior.
    """
    shares, vectors = torch.linalg.eigh(_others(whole, each.hessian))
    along = (each.gradient @ whole.basis)[:, None] @ vectors * shares.rsqrt()[:, None]
    steps = (along @ vectors.mT)[:, 0] @ whole.basis.T
    return steps.T @ steps


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


class GroupSums(NamedTuple):
    """Weighted sums of products of the columns of each group.

    Attributes:
        products: Shape (G, S, S), in the order: P unknowns, R random effects, the observation.
        size: Observations of each group, shape (G,).
        random: R.
    """

    products: Tensor
    size: Tensor
    random: int

    @property
    def unknowns(self) -> int:
        """P, how many unknowns the groups share."""
        return self.products.shape[1] - self.random - 1


class Variances(NamedTuple):
    """What the spread of the data says.

    Attributes:
        noise: Variance of an observation of weight 1.
        random: Of each random effect, shape (R,).
        unknowns: Prior variance of each unknown, shape (P,); infinite: no prior.
    """

    noise: float
    random: Tensor
    unknowns: Tensor


class Estimate(NamedTuple):
    """The shared unknowns.

    Attributes:
        mean: Shape (P,).
        covariance: Shape (P, P).
        variances: With which they were estimated.
    """

    mean: Tensor
    covariance: Tensor
    variances: Variances


class Classes(NamedTuple):
    """Which variances are one, and what was believed of them before.

    Attributes:
        of_random: Class of each random effect, shape (R,).
        of_unknown: Class of each unknown, shape (P,); -1: its prior is not estimated.
        believed_random: Variance of each class before any data, which counts as one more effect.
        believed_unknown: The same for the classes of the unknowns.
        largest_random: Largest variance of each effect, shape (R,), or of all.
    """

    of_random: Tensor
    of_unknown: Tensor
    believed_random: Tensor
    believed_unknown: Tensor
    largest_random: Tensor = torch.tensor(torch.inf)


def reduced(sums: GroupSums, noise: Tensor, random_precision: Tensor) -> tuple[Tensor, Tensor]:
    """Integrate the random effects out.

    Args:
        sums: Of each group.
        noise: Variance of an observation of weight 1, in each group, shape (G,).
        random_precision: One over the variance of each effect, shape (R,) or (G, R); 0: unknown.

    Returns:
        Normal equations of each group in the shared unknowns: precision (G, P, P), right (G, P).
    """
    spread, cross = _of_effects(sums, noise, random_precision)
    others = [*range(sums.unknowns), -1]
    left = sums.products[:, others][:, :, others] - cross.mT @ spread @ cross
    left = left / noise[:, None, None]
    return left[:, :-1, :-1], left[:, :-1, -1]


def estimate(sums: GroupSums, prior_precision: Tensor, of: Classes) -> Estimate:
    """Estimate the unknowns and the variances together, starting from what was believed of these.

    The variances are found by expectation maximisation of the marginal likelihood (Laird and Ware
    1982), in the form of MacKay (1992), which has the same fixed point and does not stall at
    variances that are far too small.

    Args:
        sums: Of each group.
        prior_precision: A fixed prior of mean zero on the unknowns, shape (P, P).
        of: Which variances are one.
    """
    variances = Variances(
        noise=1.0,
        random=of.believed_random[of.of_random],
        unknowns=torch.where(of.of_unknown < 0, torch.inf, of.believed_unknown[of.of_unknown]),
    )
    # Splits of a Kinect v2's recording settled in 10 to 40 steps: a standard deviation is then
    # known far better than the data determine it.
    for _ in range(60):
        before = variances
        variances = _updated(sums, unknowns_given(sums, prior_precision, before), of)
        if 100 * _change(before, variances) < 1:
            break
    return unknowns_given(sums, prior_precision, variances)


def _change(before: Variances, after: Variances) -> float:
    known = before.unknowns.isfinite()
    pairs = (before.random, after.random), (before.unknowns[known], after.unknowns[known])
    changes = [(new / old).log().abs().max() for old, new in pairs if len(old)]
    return float(torch.stack(changes).max())


def unknowns_given(sums: GroupSums, prior_precision: Tensor, variances: Variances) -> Estimate:
    """Estimate the unknowns with given variances; arguments as of `estimate`."""
    noise = torch.full_like(sums.size, variances.noise)
    each, right = reduced(sums, noise, 1 / variances.random)
    covariance = inverse(each.sum(dim=0) + prior_precision + (1 / variances.unknowns).diag())
    return Estimate(covariance @ right.sum(dim=0), covariance, variances)


def random_effects(sums: GroupSums, found: Estimate) -> tuple[Tensor, Tensor]:
    """Return the effects of each group, and the variances that they are uncertain by.

    Args:
        sums: Of each group.
        found: The shared unknowns.

    Returns:
        Two tensors of shape (G, R).
    """
    noise, precision = found.variances.noise, 1 / found.variances.random
    spread, cross = _of_effects(sums, torch.full_like(sums.size, noise), precision)
    lever, right = (spread @ cross).tensor_split([sums.unknowns], dim=2)
    effects = right[:, :, 0] - lever @ found.mean
    uncertainty = noise * spread.diagonal(dim1=1, dim2=2)
    return effects, uncertainty + (lever @ found.covariance * lever).sum(dim=2)


def _updated(sums: GroupSums, found: Estimate, of: Classes) -> Variances:
    """Return the variances that the squares of unknowns, effects and residuals suggest."""
    before = found.variances
    effects, uncertainty = random_effects(sums, found)
    known = 1 - uncertainty / before.random
    random = _by_class(effects.square().sum(0), known.sum(0), of.of_random, of.believed_random)
    random = torch.minimum(random, of.largest_random)
    known = 1 - found.covariance.diagonal() / before.unknowns
    unknowns = _by_class(found.mean.square(), known, of.of_unknown, of.believed_unknown)
    ones = torch.ones(len(effects), 1).to(effects)
    solution = torch.cat([-found.mean.expand(len(effects), -1), -effects, ones], dim=1)
    rest = (solution[:, None, :] @ sums.products @ solution[:, :, None]).sum()
    freedom = sums.size.sum() - effects.numel() - sums.unknowns
    return Variances(float(rest / freedom.clamp(min=1)), random, unknowns)


def _by_class(squares: Tensor, known: Tensor, of: Tensor, believed: Tensor) -> Tensor:
    """Return the variance of each class at each of its members; infinite where of is -1.

    Args:
        squares: Sum of the squares of each member's values.
        known: How many of these values the data determine, rather than the variance itself.
        of: Class of each member.
        believed: Of each class, see `Classes`.
    """
    variance = torch.full_like(squares, torch.inf)
    for number, before in enumerate(believed):
        own = of == number
        found = (squares[own].sum() + before) / (known[own].sum().clamp(min=0) + 1)
        variance[own] = found.clamp(max=_LARGEST_VARIANCE)
    return variance


def _of_effects(sums: GroupSums, noise: Tensor, precision: Tensor) -> tuple[Tensor, Tensor]:
    """Return the inverse of the effects' products and their prior, and their products with X, y."""
    first, last = sums.unknowns, sums.unknowns + sums.random
    rows = sums.products[:, first:last]
    within = rows[:, :, first:last] + (noise[:, None] * precision).diag_embed()
    return inverse(within), torch.cat([rows[:, :, :first], rows[:, :, last:]], dim=2)


@contextmanager
def solvable(
    path: Path,
    task: str,
    reason: str = "frames hardly differ, or poses, planes or depth are off; see `tofcorr inspect`.",
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
        raise CalibrationDataError(f"{path}: the {task} has no solution: {reason}") from None
