r"""A stated belief about what the images leave free.

.. math:: \sum_v w_v r_v^2 + s^2 \lVert L\,\delta \rVert^2

with :math:`\delta` the step from the starting guess, and :math:`s^2` the effective variance of a
residual. L acts on the free directions alone: what the images do tell is not touched.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from tofcorr.estimation.objective import NormalEquations, Objective
from tofcorr.estimation.observability import BELIEF, Observability
from tofcorr.estimation.parameters import Parameters
from tofcorr.geometry import se3


@dataclass(frozen=True)
class Prior:
    """A Gaussian belief around a guess, along some directions.

    Attributes:
        centre: The guess.
        factor: The rows L, in standard deviations per metre or radian, shape (F, P).
        variance: The effective variance of a residual, which puts both parts on one scale, in
            the unit of the loss.
        names: What each row is about, in words.
    """

    centre: Parameters
    factor: Tensor
    variance: float
    names: list[str]

    def deviation(self, parameters: Parameters) -> Tensor:
        """Return L times the step from the guess, shape (F,); differentiable."""
        change = parameters.coefficients - self.centre.coefficients
        if parameters.hand_eye_is_free:
            moved = se3.inverse(self.centre.tool_from_camera) @ parameters.tool_from_camera
            change = torch.cat([se3.log(moved), change])
        return self.factor @ change

    def equations(self, parameters: Parameters) -> NormalEquations:
        """Return the prior's part of the normal equations at `parameters`."""
        zero = torch.zeros(parameters.size, dtype=torch.float64)
        deviation = self.deviation(parameters)
        jacobian = torch.autograd.functional.jacobian(
            lambda step: self.deviation(parameters.moved(step)), zero
        )
        assert isinstance(jacobian, Tensor)
        return NormalEquations(
            self.variance * deviation.square().sum(),
            self.variance * deviation @ jacobian,
            self.variance * jacobian.T @ jacobian,
        )


def prior_on_free_directions(
    found: Observability, guess: Parameters, variance: float
) -> Prior | None:
    """Return a belief of 100 mm and 100 mrad around the guess along what is free, if anything is.

    Args:
        found: What the images leave open.
        guess: The start; its coefficients count as well.
        variance: The effective variance of a residual.
    """
    free = [k for k, direction in enumerate(found.directions) if direction.is_free]
    if not free:
        return None
    factor = found.vectors[:, free].T.contiguous() / BELIEF
    names = [found.directions[k].in_words() for k in free]
    return Prior(guess, factor, variance, names)


class WithPrior:
    """An objective with the belief added.

    Args:
        objective: The images' part.
        prior: The belief.
    """

    def __init__(self, objective: Objective, prior: Prior) -> None:
        self.objective = objective
        self.prior = prior

    @property
    def num_residuals(self) -> float:
        """How many residuals the images' part sums."""
        return self.objective.num_residuals

    def loss(self, parameters: Parameters) -> Tensor:
        """Return the loss, differentiable."""
        belief = self.prior.deviation(parameters).square().sum()
        return self.objective.loss(parameters) + self.prior.variance * belief

    def change(self, origin: Parameters, step: Tensor) -> Tensor:
        """Return the change of the loss by a step, differentiable."""
        before = self.prior.deviation(origin)
        after = self.prior.deviation(origin.moved(step))
        belief = ((after - before) * (after + before)).sum()
        return self.objective.change(origin, step) + self.prior.variance * belief

    def normal_equations(self, parameters: Parameters) -> NormalEquations:
        """Return loss, gradient and Gauss-Newton Hessian of both parts."""
        images = self.objective.normal_equations(parameters)
        belief = self.prior.equations(parameters)
        return NormalEquations(*(a + b for a, b in zip(images, belief, strict=True)))
