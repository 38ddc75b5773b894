"""The residual network: fitted to what a core leaves, and kept if runs of unseen images gain.

Successive images are alike: the target has hardly moved. An image held out between two that were
seen asks no more than that the network repeats them. So runs of successive poses are held out, and
a network must do better there on average and in the tail, in mean absolute and mean squared error.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from itertools import product

import numpy as np
import torch
from torch import Tensor

from tofcorr.error_terms.model import ErrorModel
from tofcorr.error_terms.residual import ResidualNetwork
from tofcorr.estimation.linear import ROUNDING, solved
from tofcorr.estimation.moments import MomentObjective, Parameters
from tofcorr.estimation.regularisation import total_weight
from tofcorr.estimation.robust import LEVEL, student_tail
from tofcorr.estimation.solvers import minimise
from tofcorr.fit.problem import Core, Problem, ResidualOptions
from tofcorr.pixels.sample import FramePixels, draw_pixels

# The radius is tried shorter and longer along distance, log amplitude, and rows with columns: an
# error that does not depend on an input is learnt from all of its values, and then the same pixels
# show a finer curve along the others.
_STEPS = tuple(product(((1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 1)), (1 / 4, 4)))


def fit_residual(
    problem: Problem, core: Core, error: ErrorModel, options: ResidualOptions
) -> tuple[str, ResidualNetwork | None, Parameters]:
    """Fit a network to what a core leaves, and decide by cross-validation whether it stays.

    Args:
        problem: What was fitted.
        core: The parametric part, at the least loss.
        error: Its error model, with its fixed pattern if it has one; its coefficients are not
            looked at.
        options: Size, fit, decision.

    Returns:
        The decision in one sentence; the network, fitted to all images, None if it was dropped;
        hand-eye and coefficients that go with it.
    """
    sample = draw_pixels(problem.dataset, problem.frames, options.pixels, options.network.seed)
    pose = problem.poses()
    folds = min(options.folds, number := int(pose.max()) + 1)
    untrained = partial(ResidualNetwork, options.network, problem.domain)

    def held_out(stretch: Sequence[float]) -> Tensor:
        """Return mean absolute and squared error of each pose, without and with a network."""
        found = torch.full((2, 2, number), torch.nan, dtype=torch.float64)
        for fold in range(folds if folds > 1 else 0):
            test = pose * folds // number == fold
            here = test[sample.frame]
            refitted, unseen = _without(core, test), sample.of(here)
            trained = _train(refitted, error, sample.of(~here), untrained(stretch), options)
            of = pose[unseen.frame]
            seen = torch.bincount(of, minlength=number)
            for row, (network, best) in enumerate([(None, refitted.solution.parameters), trained]):
                off = _distance_to_plane(error, unseen, best, network)
                sums = [torch.bincount(of, one, number) for one in (off.abs(), off.square())]
                found[row, :, seen > 0] = (torch.stack(sums) / seen)[:, seen > 0]
        return found[:, :, found[0, 0].isfinite()]

    stretch, measured = (1.0,) * 4, held_out((1.0,) * 4)
    for along, longer in _STEPS:
        other = tuple(one * longer**k for one, k in zip(stretch, along, strict=True))
        if gate(measured[1], (its := held_out(other))[1]) < LEVEL:
            stretch, measured = other, its
    # The first is no choice; of another the probability is that of the best tried (Bonferroni).
    tried = 1 if stretch == (1.0,) * 4 else 1 + len(_STEPS)
    p_value = min(1.0, tried * gate(*measured))
    network, best = None, core.solution.parameters
    if options.keep == "always" or p_value < LEVEL:
        network, best = _train(core, error, sample, untrained(stretch), options)
    (mean, square), (its_mean, its_square) = measured.mean(dim=2).tolist()
    kept = f"The residual network was {'dropped' if network is None else 'kept'}: held-out runs of"
    found = f"{1e3 * its_square**0.5:.2f} mm RMS and {1e3 * its_mean:.2f} mm mean absolute error"
    bare = f"{1e3 * square**0.5:.2f} and {1e3 * mean:.2f} without (p = {p_value:.3g})"
    return f"{kept} images have {found}, {bare}.", network, best


def gate(without: Tensor, with_network: Tensor) -> float:
    """Return the probability of so large gains by chance, of the measure that gains less surely.

    One-sided t tests over the poses; 1 with fewer than three poses, too few for one.

    Args:
        without: Mean absolute and mean squared error of each held-out pose, shape (2, G).
        with_network: The same with the network.
    """
    gains = (without - with_network).numpy()
    number = gains.shape[1]
    if number < 3 or not gains.any(axis=1).all():
        return 1.0
    with np.errstate(divide="ignore"):
        statistics = gains.mean(axis=1) / (gains.std(axis=1, ddof=1) / number**0.5)
    return max(student_tail(float(one), number - 1) for one in statistics)


def _without(core: Core, images: Tensor) -> Core:
    """Fit the core anew without some images, given as a mask (N,)."""
    moments, smooth = core.moments.images(~images), core.smoothness
    if smooth is not None:
        share = total_weight(moments) / total_weight(core.moments)
        smooth = replace(smooth, variance=smooth.variance * share)
    solution = minimise(MomentObjective(moments, smooth), core.solution.parameters)
    return replace(core, moments=moments, solution=solution, smoothness=smooth)


@torch.no_grad()
def _distance_to_plane(
    error: ErrorModel, sample: FramePixels, at: Parameters, network: ResidualNetwork | None
) -> Tensor:
    """Return the signed distance (M,) of the corrected sample to its planes, metres."""
    found = at.coefficients @ error.columns_at(sample.pixels) + error.pattern_at(sample.pixels)
    if network is not None:
        found = found + network(*sample.pixels[:4])
    return sample.distance_to_plane(at.tool_from_camera, found)


@torch.no_grad()
def _train(
    core: Core, error: ErrorModel, seen: FramePixels, network: ResidualNetwork, how: ResidualOptions
) -> tuple[ResidualNetwork, Parameters]:
    """Fit a network, and the unknowns with it where the options and the hand-eye ask for that.

    A hand-eye transform that the core's errors have bent leaves residuals of each pose, which are
    no function of a pixel. Without one the core stays as it is: beside the network it would lean
    on it, and be wrong where the network has seen nothing.
    """
    best, inputs = core.solution.parameters, network.scaled(*seen.pixels[:4])
    network.look_at(inputs)
    functions = network.fade(inputs)[:, None] * network.functions(inputs, network.places)
    # The energy of the function: the square of its norm where Wendland's is the kernel.
    penalty = how.weight_decay * network.functions(network.places, network.places)
    size = best.size if how.joint and best.hand_eye_is_free else 0
    columns, total = error.columns_at(seen.pixels), total_weight(core.moments)
    for _ in range(how.iterations):
        cosine = seen.cosine(best.tool_from_camera)
        left = _distance_to_plane(error, seen, best, None)
        normal = seen.normal_tool @ best.tool_from_camera[:3, :3]
        found = best.coefficients @ columns + error.pattern_at(seen.pixels)
        points = seen.ray * (seen.pixels.radial_distance - found)[:, None]
        turned = torch.linalg.cross(points, normal)
        moves = torch.cat([normal, turned, -cosine[:, None] * columns.T], dim=1)[:, :size]
        slope = torch.cat([moves, -cosine[:, None] * functions], dim=1)
        hessian, gradient = slope.T @ slope / len(left), left @ slope / len(left)
        hessian[size:, size:] += penalty
        if size and core.total_prior is not None:
            prior = core.total_prior.equations(best)
            hessian[:size, :size] += prior.hessian / total
            gradient[:size] += prior.gradient / total
        step, weights = (-solved(hessian, gradient)).tensor_split([size])
        network.weights.copy_(weights)
        if not size or float(step.abs().max()) < ROUNDING**0.5:  # A micrometre, a microradian.
            break
        best = best.moved(step).detached()
    return network, best
