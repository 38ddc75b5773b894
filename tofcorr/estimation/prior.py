r"""A Gaussian prior on directions that the images do not determine.

.. math:: \sum_v w_v r_v^2 + s^2 \lVert L\,\delta \rVert^2

with :math:`\delta` the step from the starting guess, and :math:`s^2` the effective variance of a
residual. L acts on the undetermined directions alone: what the images do determine stays as it is.
"""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from tofcorr.estimation.information import PRIOR_SIGMA
from tofcorr.estimation.linear import NormalEquations
from tofcorr.estimation.objective import Objective
from tofcorr.estimation.observability import Observability
from tofcorr.estimation.parameters import Parameters
from tofcorr.geometry import se3


@dataclass(frozen=True)
class Prior:
    """A Gaussian prior around a guess, along some directions.

    Attributes:
        centre: The guess.
        factor: The rows L, in standard deviations per metre or radian, shape (F, P).
        variance: The effective variance of a residual, which puts both parts on one scale, in
            the unit of the loss.
        names: The direction of each row, in words.
        target: Prior mean of L times the step from the guess, shape (F,); None: zero.
    """

    centre: Parameters
    factor: Float[Tensor, "F P"]
    variance: float
    names: list[str]
    target: Float[Tensor, "F"] | None = None

    def deviation(self, parameters: Parameters) -> Float[Tensor, "F"]:
        """Return L times the step from the guess, less its target, shape (F,); differentiable."""
        change = parameters.coefficients - self.centre.coefficients
        if parameters.hand_eye_is_free:
            moved = se3.inverse(self.centre.tool_from_camera) @ parameters.tool_from_camera
            change = torch.cat([se3.log(moved), change])
        deviation = self.factor @ change
        return deviation if self.target is None else deviation - self.target

    def _jacobian(self, parameters: Parameters) -> Float[Tensor, "F P"]:
        """Return the derivative of the deviation by a step, shape (F, P)."""
        by_twist = self.factor[:, : parameters.twist_size]
        if not bool(by_twist.any()):  # Linear in the coefficients.
            return self.factor
        start = se3.inverse(self.centre.tool_from_camera) @ parameters.tool_from_camera
        turned = torch.autograd.functional.jacobian(
            lambda twist: se3.log(start @ se3.exp(twist)), torch.zeros(6, dtype=torch.float64)
        )
        assert isinstance(turned, Tensor)
        return torch.cat([by_twist @ turned, self.factor[:, parameters.twist_size :]], dim=1)

    def rescaled(self, variance: float) -> "Prior":
        """Return the same prior on the scale of another effective variance of a residual."""
        grown = math.sqrt(self.variance / variance)
        target = None if self.target is None else self.target * grown
        return replace(self, factor=self.factor * grown, variance=variance, target=target)

    def joined(self, other: "Prior") -> "Prior":
        """Return this prior together with one that is about coefficients alone."""
        other = other.rescaled(self.variance)
        own = other.factor[:, self.centre.twist_size :]
        apart = own @ (other.centre.coefficients - self.centre.coefficients)
        first, second = (
            prior.factor.new_zeros(len(prior.factor)) if prior.target is None else prior.target
            for prior in (self, other)
        )
        return replace(
            self,
            factor=torch.cat([self.factor, other.factor]),
            names=[*self.names, *other.names],
            target=torch.cat([first, second + apart]),
        )

    def equations(self, parameters: Parameters) -> NormalEquations:
        """Return the prior's part of the normal equations at `parameters`."""
        deviation = self.deviation(parameters)
        jacobian = self._jacobian(parameters)
        return NormalEquations(
            self.variance * deviation.square().sum(),
            self.variance * deviation @ jacobian,
            self.variance * jacobian.T @ jacobian,
        )


def prior_on_undetermined(found: Observability, guess: Parameters) -> Prior | None:
    """Return a prior of 100 mm and 100 mrad around the guess along the undetermined directions.

    Args:
        found: How well the images determine each direction.
        guess: The start; its coefficients count as well.

    Returns:
        The prior; None if every direction is determined.
    """
    rows = [k for k, direction in enumerate(found.directions) if direction.is_undetermined]
    if not rows:
        return None
    factor = found.vectors[:, rows].T.contiguous() / PRIOR_SIGMA
    names = [found.directions[k].in_words() for k in rows]
    return Prior(guess, factor, found.variance, names)


class WithPrior:
    """An objective with a prior added.

    Args:
        objective: The images' part.
        prior: The prior.
    """

    def __init__(self, objective: Objective, prior: Prior) -> None:
        self.objective = objective
        self.prior = prior

    @property
    def num_residuals(self) -> float:
        """How many residuals the images' part sums."""
        return self.objective.num_residuals

    def loss(self, parameters: Parameters) -> Float[Tensor, ""]:
        """Return the loss, differentiable."""
        penalty = self.prior.deviation(parameters).square().sum()
        return self.objective.loss(parameters) + self.prior.variance * penalty

    def change(self, origin: Parameters, step: Float[Tensor, "P"]) -> Float[Tensor, ""]:
        """Return the change of the loss by a step, differentiable."""
        before = self.prior.deviation(origin)
        after = self.prior.deviation(origin.moved(step))
        penalty = ((after - before) * (after + before)).sum()
        return self.objective.change(origin, step) + self.prior.variance * penalty

    def normal_equations(self, parameters: Parameters) -> NormalEquations:
        """Return loss, gradient and Gauss-Newton Hessian of both parts."""
        images = self.objective.normal_equations(parameters)
        prior = self.prior.equations(parameters)
        return NormalEquations(*(a + b for a, b in zip(images, prior, strict=True)))
