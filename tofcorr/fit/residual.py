"""The residual network: trained on what a fitted core leaves, kept if held-out images gain."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from pydantic import Field, NonNegativeFloat, PositiveInt
from torch import Tensor

from tofcorr.error_terms.base import Domain
from tofcorr.error_terms.model import ErrorModel
from tofcorr.error_terms.residual import ResidualNetwork, ResidualNetworkOptions
from tofcorr.estimation.moments import (
    ImageMoments,
    MomentObjective,
    Objective,
    Parameters,
    Prior,
    WithPrior,
)
from tofcorr.estimation.regularisation import total_weight
from tofcorr.estimation.robust import student_tail
from tofcorr.estimation.solvers import SolverOptions, minimise, whitening
from tofcorr.options import Options
from tofcorr.pixels.sample import FramePixels


class ResidualOptions(Options):
    """How the residual network is trained, and when it is kept.

    Attributes:
        network: Its size and bound.
        pixels: How many pixels it is trained on, of all frames together.
        iterations: Most iterations of L-BFGS, of each of the two stages.
        weight_decay: Weight of the sum of squared network weights in a loss that is 1 without
            the network.
        joint: Whether hand-eye and coefficients are fitted once more together with the network.
            Without this, errors that the core cannot describe bias them.
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


def core_error(model: ErrorModel, sample: FramePixels, coefficients: Tensor) -> Tensor:
    """Return what terms and fixed pattern predict at the sample, shape (M,), metres."""
    with torch.no_grad():
        columns = model.columns_at(sample.pixels)
        return coefficients @ columns + model.pattern_at(sample.pixels)


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
        solution = minimise(objective, self.parameters, SolverOptions(kind="levenberg_marquardt"))
        return replace(self, moments=moments, parameters=solution.parameters, smoothness=smoothness)


def train_network(
    core: FittedCore, sample: FramePixels, domain: Domain, options: ResidualOptions
) -> tuple[ResidualNetwork, Parameters]:
    """Train a network with the core fixed, and then, if the options say so, both together."""
    network = ResidualNetwork(options.network, domain)
    parameters = core.parameters
    cosine = sample.cosine(parameters.tool_from_camera)
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
        loss = sample.distance_to_plane(moved.tool_from_camera, error).square().mean()
        if core.smoothness is not None:
            penalty = core.smoothness.deviation(moved).square().sum()
            loss = loss + core.smoothness.variance / total_weight(core.moments) * penalty
        return loss / scale + _decay(network, options)

    _minimise([*weights, step], loss_of_both, options.iterations)
    return network, parameters.moved(white @ step.detach()).detached()


def distance_to_plane(
    model: ErrorModel,
    sample: FramePixels,
    parameters: Parameters,
    network: ResidualNetwork | None,
) -> Tensor:
    """Return the signed distance (M,) of the corrected sample to its planes, metres."""
    error = core_error(model, sample, parameters.coefficients)
    if network is not None:
        with torch.no_grad():
            error = error + network(*sample.pixels[:4])
    return sample.distance_to_plane(parameters.tool_from_camera, error)


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


# A network is kept if a gain this large would arise by chance with less than this probability;
# the customary level of a one-sided test.
_LEVEL = 0.05


@dataclass(frozen=True)
class ResidualOutcome:
    """How the residual network was decided on.

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
        decision = "was kept" if self.kept else "was dropped"
        return (
            f"The residual network {decision}: on held-out images {self.network_mm:.2f} mm RMS "
            f"with it, {self.core_mm:.2f} mm without (p = {self.p_value:.3g})."
        )


def fit_residual(
    core: FittedCore,
    sample: FramePixels,
    groups: np.ndarray,
    domain: Domain,
    options: ResidualOptions,
) -> ResidualOutcome:
    """Train the network, and decide by cross-validation whether it stays.

    Args:
        core: The fitted core.
        sample: Pixels of the images fitted.
        groups: An integer an image, shape (N,), the same for images of one pose.
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
    """Return the probability of so large a mean gain, over the poses, if there were none.

    One-sided t test; 1 with fewer than three poses, too few for one.
    """
    if len(gain) < 3 or not np.any(gain):
        return 1.0
    standard_error = gain.std(ddof=1) / len(gain) ** 0.5
    return student_tail(gain.mean() / max(standard_error, 1e-300), len(gain) - 1)


def _held_out(
    core: FittedCore,
    sample: FramePixels,
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
        refitted = core.without(test)
        network, parameters = train_network(refitted, sample.of(~test), domain, options)
        held_out = sample.of(test)
        for target, trained, at in (
            (without, None, refitted.parameters),
            (with_network, network, parameters),
        ):
            square = distance_to_plane(core.model, held_out, at, trained).square()
            for image in torch.unique(held_out.frame).tolist():
                target[image] = float(square[held_out.frame == image].mean())
    return without, with_network
