"""The residual network: trained on what a fitted core leaves, kept if held-out images gain."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from tofcorr.error_terms.base import Domain
from tofcorr.error_terms.model import ErrorModel
from tofcorr.error_terms.residual import ResidualNetwork
from tofcorr.estimation.linear import Curvature
from tofcorr.estimation.moments import MomentObjective, Parameters
from tofcorr.estimation.regularisation import total_weight
from tofcorr.estimation.robust import LEVEL, student_tail
from tofcorr.estimation.solvers import minimise
from tofcorr.fit.problem import Core, Problem, ResidualOptions
from tofcorr.pixels.sample import FramePixels, draw_pixels


def fit_residual(
    problem: Problem, core: Core, error: ErrorModel, options: ResidualOptions
) -> tuple[str, ResidualNetwork | None, Parameters]:
    """Train a network on what a core leaves, and decide by cross-validation whether it stays.

    Args:
        problem: What was fitted.
        core: The parametric part, at the least loss.
        error: Its error model, with its fixed pattern if it has one; its coefficients are not
            looked at.
        options: Size, training, decision.

    Returns:
        The decision in one sentence; the network, trained on all images, None if it was dropped;
        hand-eye and coefficients that go with it.
    """
    frames, domain = np.sort(problem.frames), problem.domain
    sample = draw_pixels(problem.dataset, frames, options.pixels, options.network.seed)
    pose = np.unique(problem.dataset.pose_groups()[frames], return_inverse=True)[1]
    # Each held-out image's mean squared distance, without the network and with it.
    square = np.full((2, len(frames)), np.nan)
    folds = min(options.folds, int(pose.max()) + 1)
    for fold in range(folds if folds > 1 else 0):
        test = torch.from_numpy(pose % folds == fold)
        here = test[sample.frame]
        refitted, held_out = _without(core, test), sample.of(here)
        trained = _train(refitted, error, sample.of(~here), domain, options)
        for row, (network, best) in enumerate([(None, refitted.solution.parameters), trained]):
            off = _distance_to_plane(error, held_out, best, network).square()
            for image in torch.unique(held_out.frame).tolist():
                square[row, image] = float(off[held_out.frame == image].mean())
    seen = np.unique(pose[np.isfinite(square[0])])
    gain = np.array([np.nanmean((square[0] - square[1])[pose == one]) for one in seen])
    p_value = _p_value(gain)
    network, best = None, core.solution.parameters
    if options.keep == "always" or p_value < LEVEL:
        network, best = _train(core, error, sample, domain, options)
    without, with_network = (1e3 * float(np.nanmean(row)) ** 0.5 for row in square)
    kept = f"The residual network was {'dropped' if network is None else 'kept'}: held-out images"
    words = f"{kept} have {with_network:.2f} mm RMS, {without:.2f} without (p = {p_value:.3g})."
    return words, network, best


def _p_value(gain: np.ndarray) -> float:
    """Return the probability of so large a mean gain, over the poses, if there were none.

    One-sided t test; 1 with fewer than three poses, too few for one.
    """
    if len(gain) < 3 or not np.any(gain):
        return 1.0
    with np.errstate(divide="ignore"):
        statistic = gain.mean() / (gain.std(ddof=1) / len(gain) ** 0.5)
    return student_tail(float(statistic), len(gain) - 1)


def _without(core: Core, images: Tensor) -> Core:
    """Fit the core anew without some images, given as a mask (N,)."""
    moments, smooth = core.moments.images(~images), core.smoothness
    if smooth is not None:
        share = total_weight(moments) / total_weight(core.moments)
        smooth = replace(smooth, variance=smooth.variance * share)
    solution = minimise(MomentObjective(moments, smooth), core.solution.parameters)
    return replace(core, moments=moments, solution=solution, smoothness=smooth)


def _distance_to_plane(
    error: ErrorModel, sample: FramePixels, at: Parameters, network: ResidualNetwork | None
) -> Tensor:
    """Return the signed distance (M,) of the corrected sample to its planes, metres."""
    with torch.no_grad():
        found = at.coefficients @ error.columns_at(sample.pixels) + error.pattern_at(sample.pixels)
        if network is not None:
            found = found + network(*sample.pixels[:4])
    return sample.distance_to_plane(at.tool_from_camera, found)


def _train(
    core: Core, error: ErrorModel, sample: FramePixels, domain: Domain, options: ResidualOptions
) -> tuple[ResidualNetwork, Parameters]:
    """Train a network with the core fixed, and then, if the options say so, both together."""
    network, best = ResidualNetwork(options.network, domain), core.solution.parameters
    cosine = sample.cosine(best.tool_from_camera)
    left = _distance_to_plane(error, sample, best, None)
    scale = left.square().mean().clamp(min=torch.finfo(left.dtype).tiny)
    inputs = network.scaled(*sample.pixels[:4])
    weights = list(network.parameters())

    def decayed(loss: Tensor) -> Tensor:
        squares = torch.stack([weight.square().sum() for weight in weights]).sum()
        return loss / scale + options.weight_decay * squares

    def loss_of_network() -> Tensor:
        return decayed((left - cosine * network.of_scaled(*inputs)).square().mean())

    _minimise(weights, loss_of_network, options.iterations)
    if not options.joint:
        return network, best
    columns = error.columns_at(sample.pixels).detach()
    pattern = error.pattern_at(sample.pixels)
    total, smooth = total_weight(core.moments), core.smoothness
    # Steps of about equal effect on the loss.
    hessian = MomentObjective(core.moments).normal_equations(best).hessian
    white = Curvature(hessian / (total * float(scale))).basis
    step = torch.zeros(best.size, dtype=torch.float64, requires_grad=True)

    def loss_of_both() -> Tensor:
        moved = best.moved(white @ step)
        found = moved.coefficients @ columns + pattern + network.of_scaled(*inputs)
        loss = sample.distance_to_plane(moved.tool_from_camera, found).square().mean()
        if smooth is not None:
            loss = loss + smooth.variance / total * smooth.deviation(moved).square().sum()
        return decayed(loss)

    _minimise([*weights, step], loss_of_both, options.iterations)
    return network, best.moved(white @ step.detach()).detached()


def _minimise(unknowns: Sequence[Tensor], loss_of: Callable[[], Tensor], iterations: int) -> None:
    """Minimise a loss without unit, 1 at the start, by L-BFGS.

    The limit on iterations ends most trainings; the tolerances are far below what a held-out error
    can tell.
    """
    search = {"max_iter": iterations, "history_size": 20, "line_search_fn": "strong_wolfe"}
    optimiser = torch.optim.LBFGS(unknowns, **search)

    def closure() -> Tensor:
        optimiser.zero_grad()
        loss = loss_of()
        loss.backward()
        return loss

    optimiser.step(closure)  # type: ignore[arg-type]
