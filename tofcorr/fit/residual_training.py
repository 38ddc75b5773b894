"""Trains the residual network on what a fitted core leaves.

The loss is that of the core, point to plane, over a sample of pixels.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from tofcorr.error_terms.domain import Domain
from tofcorr.error_terms.model import ErrorModel
from tofcorr.error_terms.residual import ResidualNetwork
from tofcorr.estimation import levenberg_marquardt
from tofcorr.estimation.lbfgs import whitening
from tofcorr.estimation.moments import ImageMoments
from tofcorr.estimation.objective import MomentObjective, Objective
from tofcorr.estimation.optimisers import uncompiled
from tofcorr.estimation.parameters import Parameters
from tofcorr.estimation.prior import Prior, WithPrior
from tofcorr.estimation.regularisation import total_weight
from tofcorr.fit.residual_options import ResidualOptions
from tofcorr.fit.residual_sample import ResidualSample, core_error


@dataclass(frozen=True)
class FittedCore:
    """What a network is trained on top of.

    Attributes:
        model: The error model, with its fixed pattern if it has one; its coefficients are not
            looked at, those of `parameters` are.
        moments: Of the images fitted.
        parameters: The optimum.
        smoothness: The smoothing penalties that were part of the loss; None without any.
    """

    model: ErrorModel
    moments: ImageMoments
    parameters: Parameters
    smoothness: Prior | None

    def without(self, images: Tensor) -> "FittedCore":
        """Fit the core anew without some images, given as a mask (N,)."""
        moments = self.moments.images(~images)
        objective: Objective = MomentObjective(moments)
        smoothness = self.smoothness
        if smoothness is not None:
            share = total_weight(moments) / total_weight(self.moments)
            smoothness = replace(smoothness, variance=smoothness.variance * share)
            objective = WithPrior(objective, smoothness)
        solution = levenberg_marquardt.minimise(objective, self.parameters)
        return replace(self, moments=moments, parameters=solution.parameters, smoothness=smoothness)


def train_network(
    core: FittedCore, sample: ResidualSample, domain: Domain, options: ResidualOptions
) -> tuple[ResidualNetwork, Parameters]:
    """Train a network with the core fixed, and then, if the options say so, both together."""
    network = ResidualNetwork(options.network, domain)
    parameters = core.parameters
    cosine = sample.cosine(parameters)
    left = distance_to_plane(core.model, sample, parameters, None)
    scale = left.square().mean().clamp(min=1e-300)
    inputs = network.scaled(*sample.pixels[:4])
    weights = list(network.parameters())

    def loss_of_network() -> Tensor:
        loss = (left - cosine * network.of_scaled(*inputs)).square().mean() / scale
        return loss + _decay(network, options)

    _minimise(weights, loss_of_network, options.iterations)
    if not options.joint:
        return network, parameters
    columns = core.model.columns_at(sample.pixels).detach()
    pattern = core.model.pattern_at(sample.pixels)
    white = _whitening(core, float(scale))
    step = torch.zeros(parameters.size, dtype=torch.float64, requires_grad=True)

    def loss_of_both() -> Tensor:
        moved = parameters.moved(white @ step)
        error = moved.coefficients @ columns + pattern + network.of_scaled(*inputs)
        loss = sample.distance_to_plane(moved, error).square().mean()
        if core.smoothness is not None:
            penalty = core.smoothness.deviation(moved).square().sum()
            loss = loss + core.smoothness.variance / total_weight(core.moments) * penalty
        return loss / scale + _decay(network, options)

    _minimise([*weights, step], loss_of_both, options.iterations)
    return network, parameters.moved(white @ step.detach()).detached()


def distance_to_plane(
    model: ErrorModel,
    sample: ResidualSample,
    parameters: Parameters,
    network: ResidualNetwork | None,
) -> Tensor:
    """Return the signed distance (M,) of the corrected sample to its planes, metres."""
    error = core_error(model, sample, parameters.coefficients)
    if network is not None:
        with torch.no_grad():
            error = error + network(*sample.pixels[:4])
    return sample.distance_to_plane(parameters, error)


def _whitening(core: FittedCore, scale: float) -> Tensor:
    """Return the map from steps of about equal effect on the loss to steps of the parameters."""
    hessian = MomentObjective(core.moments).normal_equations(core.parameters).hessian
    return whitening(hessian / (total_weight(core.moments) * scale))


def _decay(network: ResidualNetwork, options: ResidualOptions) -> Tensor:
    squares = [weight.square().sum() for weight in network.parameters()]
    return options.weight_decay * torch.stack(squares).sum()


def _minimise(unknowns: Sequence[Tensor], loss_of: Callable[[], Tensor], iterations: int) -> None:
    """Minimise a loss without unit, 1 at the start, by L-BFGS.

    The tolerances, on gradient and change, are far below what a held-out error can tell; the
    limit on iterations ends most trainings. Set by hand.
    """
    optimiser = uncompiled(torch.optim.LBFGS)(
        unknowns,
        max_iter=iterations,
        history_size=20,
        tolerance_grad=1e-9,
        tolerance_change=1e-10,
        line_search_fn="strong_wolfe",
    )

    def closure() -> Tensor:
        optimiser.zero_grad()
        loss = loss_of()
        loss.backward()
        return loss

    optimiser.step(closure)  # type: ignore[arg-type]
