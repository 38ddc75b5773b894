r"""How far an estimate would move if further unknowns were estimated beside it.

Residuals :math:`r = X \theta + Z \gamma` are minimised twice, with Z and without. The poses decide
whether :math:`\gamma` is there: they are left out one at a time, with one Newton step each, since
the pixels of a pose share its error. Everything follows from the products of the columns, summed
over each pose.
"""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from tofcorr.estimation.objective import NormalEquations
from tofcorr.estimation.student import f_tail

# Curvature below this share of the largest (each unknown scaled to its own) is rounding: the
# direction is left out. Set by hand.
_RESOLVED = 1e-10
# Share of a further column that the other unknowns must leave for it to be looked at, no unit.
# Chosen, far above the rounding of sums of products: what is left of less says nothing.
_LEFT = 1e-6
# Share of a direction's curvature that is added where a pose is left out that alone determines it.
# Chosen: it makes the scatter of such a direction very large, so that nothing is concluded from it.
_RIDGE = 1e-9


class Moved(NamedTuple):
    """What further unknowns say.

    Attributes:
        values: Their estimates, shape (F,), in metres at one unit of their columns.
        p_value: Probability of as large values by chance if the true ones are zero.
        shift: How far the other unknowns move, shape (P,).
    """

    values: Tensor
    p_value: float
    shift: Tensor


class FurtherUnknowns:
    """An estimate of P unknowns, to be compared with those of P + F.

    Args:
        products: Weighted sums of products of the columns of each pose, in the order: P unknowns,
            all further unknowns, the residual; shape (G, S, S).
        prior: Normal equations of a prior on the P unknowns, in the unit of the products.
    """

    def __init__(self, products: Float[Tensor, "G S S"], prior: NormalEquations) -> None:
        unknowns = len(prior.gradient)
        own = products[:, :unknowns, :unknowns]
        hessian = own.sum(dim=0) + prior.hessian
        scale = hessian.diagonal().clamp(min=1e-300).rsqrt()
        values, vectors = torch.linalg.eigh(hessian * scale[:, None] * scale)
        resolved = values > _RESOLVED * values.max()
        # In these coordinates the curvature of the whole is 1 in every direction.
        self._basis = scale[:, None] * vectors[:, resolved] * values[resolved].rsqrt()
        self._cross = self._basis.T @ products[:, :unknowns, unknowns:]
        self._whole = self._cross.sum(dim=0)
        self._whole[:, -1] += self._basis.T @ prior.gradient
        self._products = products[:, unknowns:, unknowns:]
        shares = self._basis.T @ own @ self._basis
        one = torch.eye(shares.shape[-1]).to(shares)
        self._inverse = torch.linalg.inv((1 + _RIDGE) * one - shares)

    def __call__(self, chosen: list[int]) -> Moved | None:
        """Estimate some of the further unknowns as well.

        Args:
            chosen: Their places among all further unknowns.

        Returns:
            None where the other unknowns leave nothing of a column, or where there are too few
            poses.
        """
        count, number = len(self._products), len(chosen)
        places = [*chosen, self._products.shape[-1] - 1]
        products = self._products[:, places][:, :, places]
        cross, whole = self._cross[:, :, places], self._whole[:, places]
        total = _solved(whole, products.sum(0), None)
        before = products.sum(0).diagonal()[:-1]
        if count <= number + 1 or bool((total.left < _LEFT * before).any()):
            return None
        without = _solved(whole - cross, products.sum(0) - products, self._inverse).values
        centred = without - without.mean(dim=0)
        covariance = (count - 1) / count * centred.T @ centred
        # Hotelling's T^2: as F, with the poses less one as degrees of freedom.
        square = total.values @ torch.linalg.pinv(covariance, hermitian=True) @ total.values
        freedom = count - number
        ratio = float(square) * freedom / (number * (count - 1))
        shift = -self._basis @ (whole[:, :-1] @ total.values)
        return Moved(total.values, f_tail(ratio, number, freedom), shift)


class _Solved(NamedTuple):
    """Estimates (..., F), and what the other unknowns leave of the squares of their columns."""

    values: Tensor
    left: Tensor


def _solved(cross: Tensor, products: Tensor, inverse: Tensor | None) -> _Solved:
    """Estimate the further unknowns from sums of products (..., R, F + 1), (..., F + 1, F + 1).

    `inverse` is that of the curvature of the other unknowns, None where it is 1.
    """
    solved = cross if inverse is None else inverse @ cross
    rest = products - cross.transpose(-1, -2) @ solved
    matrix, right = rest[..., :-1, :-1], rest[..., :-1, -1:]
    scale = matrix.diagonal(dim1=-2, dim2=-1).clamp(min=1e-300).rsqrt()[..., None]
    scaled = matrix * scale * scale.transpose(-1, -2)
    values = -scale * (torch.linalg.pinv(scaled, hermitian=True) @ (scale * right))
    return _Solved(values[..., 0], matrix.diagonal(dim1=-2, dim2=-1))
