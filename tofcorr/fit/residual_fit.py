"""Trains the residual network on what a fitted core leaves, and keeps it only if it helps.

The loss is that of the core, point to plane, over a sample of pixels; the network is kept when
images that were held out, pose by pose, are predicted significantly better with it.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from pydantic import Field, NonNegativeFloat, PositiveInt
from scipy import stats
from torch import Tensor

from tofcorr.error_terms.domain import Domain
from tofcorr.error_terms.model import ErrorModel
from tofcorr.error_terms.residual import ResidualNetwork, ResidualNetworkOptions
from tofcorr.estimation import levenberg_marquardt
from tofcorr.estimation.lbfgs import whitening
from tofcorr.estimation.moments import ImageMoments
from tofcorr.estimation.objective import MomentObjective, Objective
from tofcorr.estimation.parameters import Parameters
from tofcorr.estimation.prior import Prior, WithPrior
from tofcorr.estimation.regularisation import total_weight
from tofcorr.fit.residual_sample import ResidualSample, core_error
from tofcorr.options import Options

_LEVEL = 0.05


class ResidualOptions(Options):
    """How the residual network is trained, and when it is kept.

    Attributes:
        network: Its size and bound.
        pixels: How many pixels it is trained on, of all frames together.
        iterations: Most iterations of L-BFGS, of each of the two stages.
        weight_decay: Weight of the sum of squared weights against the loss, which is 1 without
            the network.
        joint: Whether hand-eye and coefficients are fitted once more together with the network;
            errors that the core cannot follow have pulled them away.
        folds: Folds of the cross-validation that decides.
        keep: `if_better` drops a network that does not help on held-out images; `always` keeps it.
    """

    network: ResidualNetworkOptions = ResidualNetworkOptions()
    pixels: PositiveInt = 10_000
    iterations: PositiveInt = 200
    weight_decay: NonNegativeFloat = 1e-3
    joint: bool = True
    folds: int = Field(default=5, ge=2)
    keep: Literal["if_better", "always"] = "if_better"


@dataclass(frozen=True)
class ResidualOutcome:
    """What became of the network.

    Attributes:
        kept: Whether the model has it.
        network: The network, trained on all images; None if it was dropped.
        parameters: Hand-eye and coefficients that go with it.
        core_mm: RMS distance of held-out pixels to their planes without it, millimetres.
        network_mm: The same with it.
        p_value: One-sided, of a network that does not help.
    """

    kept: bool
    network: ResidualNetwork | None
    parameters: Parameters
    core_mm: float
    network_mm: float
    p_value: float

    def in_words(self) -> str:
        """Return the decision in one sentence."""
        fate = "was kept" if self.kept else "was dropped"
        return (
            f"The residual network {fate}: on held-out images {self.network_mm:.2f} mm RMS with "
            f"it, {self.core_mm:.2f} mm without (p = {self.p_value:.3g})."
        )


@dataclass(frozen=True)
class FittedCore:
    """What a network is trained on top of.

    Attributes:
        model: The error model, with its fixed pattern if it has one; coefficients do not matter.
        moments: Of the images fitted.
        parameters: The optimum.
        smoothness: The belief that was part of the loss.
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


def fit_residual(
    core: FittedCore,
    sample: ResidualSample,
    groups: np.ndarray,
    domain: Domain,
    options: ResidualOptions,
) -> ResidualOutcome:
    """Train the network, and decide by cross-validation whether it stays.

    Args:
        core: The fitted core.
        sample: Pixels of the images fitted.
        groups: An integer an image, shape (N,): images of one pose share it.
        domain: The ranges that scale the network's inputs.
        options: Size, training, decision.
    """
    core_square, network_square = _held_out(core, sample, groups, domain, options)
    seen = np.unique(groups[np.isfinite(core_square)])
    gain = np.array([np.nanmean((core_square - network_square)[groups == g]) for g in seen])
    p_value = _p_value(gain)
    kept = options.keep == "always" or p_value < _LEVEL
    network, parameters = None, core.parameters
    if kept:
        network, parameters = train_network(core, sample, domain, options)
    return ResidualOutcome(
        kept=kept,
        network=network,
        parameters=parameters,
        core_mm=1e3 * float(np.nanmean(core_square)) ** 0.5,
        network_mm=1e3 * float(np.nanmean(network_square)) ** 0.5,
        p_value=p_value,
    )


def _p_value(gain: np.ndarray) -> float:
    """Return the probability of so large a mean gain if there were none."""
    if len(gain) < 3 or not np.any(gain):
        return 1.0
    spread = gain.std(ddof=1) / len(gain) ** 0.5
    return float(stats.t.sf(gain.mean() / max(spread, 1e-300), len(gain) - 1))


def _held_out(
    core: FittedCore,
    sample: ResidualSample,
    groups: np.ndarray,
    domain: Domain,
    options: ResidualOptions,
) -> tuple[np.ndarray, np.ndarray]:
    """Return each held-out image's mean squared distance without and with the network."""
    num_images = len(groups)
    _, number = np.unique(groups, return_inverse=True)
    num_folds = min(options.folds, int(number.max()) + 1)
    without, with_network = np.full(num_images, np.nan), np.full(num_images, np.nan)
    for fold in range(num_folds if num_folds > 1 else 0):
        test = torch.from_numpy(number % num_folds == fold)
        part = core.without(test)
        network, parameters = train_network(part, sample.of(~test), domain, options)
        held_out = sample.of(test)
        for target, learnt, point in (
            (without, None, part.parameters),
            (with_network, network, parameters),
        ):
            square = _distance(core.model, held_out, point, learnt).square()
            for image in torch.unique(held_out.image).tolist():
                target[image] = float(square[held_out.image == image].mean())
    return without, with_network


def _distance(
    model: ErrorModel,
    sample: ResidualSample,
    parameters: Parameters,
    network: ResidualNetwork | None,
) -> Tensor:
    error = core_error(model, sample, parameters.coefficients)
    if network is not None:
        pixels = sample.pixels
        with torch.no_grad():
            error = error + network(*pixels[:4])
    return sample.distance_to_plane(parameters, error)


def train_network(
    core: FittedCore, sample: ResidualSample, domain: Domain, options: ResidualOptions
) -> tuple[ResidualNetwork, Parameters]:
    """Train a network on a core that is held, and then, if asked, both together."""
    network = ResidualNetwork(options.network, domain)
    parameters = core.parameters
    cosine = sample.cosine(parameters)
    left = _distance(core.model, sample, parameters, None)
    scale = left.square().mean().clamp(min=1e-300)
    inputs = sample.pixels[:4]
    weights = list(network.parameters())

    def held() -> Tensor:
        loss = (left - cosine * network(*inputs)).square().mean() / scale
        return loss + _decay(network, options)

    _minimise(weights, held, options.iterations)
    if not options.joint:
        return network, parameters
    columns = core.model.columns_at(sample.pixels).detach()
    pattern = core.model.pattern_at(sample.pixels)
    white = _whitening(core, sample, float(scale))
    step = torch.zeros(parameters.size, dtype=torch.float64, requires_grad=True)

    def together() -> Tensor:
        moved = parameters.moved(white @ step)
        error = moved.coefficients @ columns + pattern + network(*inputs)
        loss = sample.distance_to_plane(moved, error).square().mean()
        if core.smoothness is not None:
            belief = core.smoothness.deviation(moved).square().sum()
            loss = loss + core.smoothness.variance / total_weight(core.moments) * belief
        return loss / scale + _decay(network, options)

    _minimise([*weights, step], together, options.iterations)
    return network, parameters.moved(white @ step.detach()).detached()


def _whitening(core: FittedCore, sample: ResidualSample, scale: float) -> Tensor:
    """Return the map from steps of about equal effect on the loss to steps of the parameters."""
    hessian = MomentObjective(core.moments).normal_equations(core.parameters).hessian
    return whitening(hessian / (total_weight(core.moments) * scale))


def _decay(network: ResidualNetwork, options: ResidualOptions) -> Tensor:
    squares = [weight.square().sum() for weight in network.parameters()]
    return options.weight_decay * torch.stack(squares).sum()


def _minimise(unknowns: Sequence[Tensor], loss_of: Callable[[], Tensor], iterations: int) -> None:
    optimiser = torch.optim.LBFGS(
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
