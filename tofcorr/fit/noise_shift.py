r"""How far the noise of the measured distances moves an estimate, and the estimate without it.

The error terms are functions of the measured distance D, which has noise of variance s^2. A pixel's
squared residual therefore contains, beyond the noise of its plane distance,

.. math:: s^2 \Big(\cos\theta\,\big(1 - \textstyle\sum_k \beta_k f_k'(D)\big)\Big)^2 ,

which is smaller where the correction shrinks all distances. The fit does so a little, and the
hand-eye transform makes up for it, above all along the viewing direction. No scatter between poses
shows that: it is the same in all of them. The expected term is a quadratic form like the moments,
with the columns' derivatives in place of the columns (the corrected score of Nakamura 1990), so one
Newton step without it says how far the least loss has moved.

Hand-eye transform, coefficients and estimated walls are moved back together: one makes up for the
other, and only together do they put corrected points on the planes.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from tofcorr.data.recording import FrameBatch
from tofcorr.errors import CalibrationDataError
from tofcorr.estimation.accumulator import Design
from tofcorr.estimation.moments import ImageMoments
from tofcorr.estimation.noise import DistanceNoise
from tofcorr.estimation.planes import joint_image_equations
from tofcorr.fit.core import Core, Held
from tofcorr.fit.problem import Problem, build_model
from tofcorr.fit.weighting import PixelWeights
from tofcorr.pixels.sample import estimate_noise

# About how many pixels the expected term is summed over, in at least so many evenly spread frames.
# Chosen: the shift of many pixels is known far better than it needs to be, in milliseconds.
_PIXELS = 50_000
_FEWEST_FRAMES = 16
# Largest variance of a distance, square metres: without amplitude it is infinite. Chosen, far above
# that of any pixel that counts.
_MOST_VARIANCE = 0.01
# Step of the derivative by the distance, metres. Chosen, far below any error's scale.
_STEP = 1e-4
# Curvature below this share of the largest is left out: the images do not determine that direction.
# Chosen, far above rounding.
_RESOLVED = 1e-9
# Largest share of a direction's curvature that counts as noise: no step is longer than ten times
# the first-order one. Chosen: a share of 0.7 (20 mm of noise, 12 poses) still gives the right step.
_MOST_OF_CURVATURE = 0.9
# Standard error of the shift, as a share of it. Measured: in 12 designs of the simulator and of
# `benchmarks/hand_eye_bias.py` the error along the view is 0.7 to 1.2 times the shift.
_UNKNOWN = 0.2


class NoiseShift(NamedTuple):
    """What the noise of the distances does to an estimate.

    Attributes:
        twist: How far it moves the hand-eye transform, in camera axes, translation first, shape
            (6,), metres and radians.
        removed: Whether the estimate was moved back.
    """

    twist: Tensor
    removed: bool

    @property
    def left(self) -> Tensor:
        """Standard error that it leaves in the hand-eye transform, as a twist (6,)."""
        return _UNKNOWN * self.twist if self.removed else self.twist


def noise_of(problem: Problem, weights: PixelWeights | None) -> DistanceNoise | None:
    """Return the noise of a measured distance; None where the recording does not determine it."""
    if weights is not None and weights.noise is not None:
        return weights.noise
    if not problem.dataset.has_amplitude:
        return None
    try:
        return estimate_noise(problem.dataset, problem.frames)
    except CalibrationDataError:
        return None


def without_noise_shift(
    problem: Problem,
    held: Held,
    weights: PixelWeights | None,
    noise: DistanceNoise | None,
    *,
    network: bool,
) -> tuple[Problem, Core, NoiseShift | None]:
    """Move an estimate back by what the noise of the distances has moved it.

    It stays at the least loss, and the shift is only stated, where the options say so, where the
    solver did not get there, and with a residual network, which is trained to the least loss too.

    Args:
        problem: What was fitted, on the walls of the fit.
        held: The core at the least loss.
        weights: The pixels' weights in the moments; None: all have the same.
        noise: The noise of a measured distance; None if unknown.
        network: Whether a residual network goes with the core.

    Returns:
        The problem, on walls moved likewise where they were estimated; the core; and the shift,
        None where it is unknown or nothing is estimated that it could move.
    """
    core = held.core
    optimum = core.solution.parameters
    if noise is None or not optimum.size:
        return problem, core, None
    step = _step_back(problem, held, weights, noise)
    options, own = problem.options, step[: optimum.size]
    removed = options.remove_noise_shift and core.solution.converged and not network
    shift = NoiseShift(-own[:6], removed) if optimum.hand_eye_is_free else None
    if not removed:
        return problem, core, shift
    moments = core.moments
    if problem.walls is not None:
        walls = problem.walls.walls.moved(step[optimum.size :])
        problem = problem.with_walls(replace(problem.walls, walls=walls), problem.start)
        moments = walls.seen_by(moments)
    solution = replace(core.solution, parameters=optimum.moved(own).detached())
    return problem, replace(core, moments=moments, solution=solution), shift


def _step_back(
    problem: Problem, held: Held, weights: PixelWeights | None, noise: DistanceNoise
) -> Tensor:
    """Return the step of unknowns and walls from the least loss to where it were without noise."""
    core = held.core
    optimum = core.solution.parameters
    walls = None if problem.walls is None else problem.walls.walls
    equations = joint_image_equations(core.moments, optimum, walls)
    hessian = equations.hessian.sum(dim=0)
    expected = _expected(problem, core, weights, noise)
    excess = joint_image_equations(expected, optimum, walls)
    if held.total_prior is not None:
        size = optimum.size
        hessian[:size, :size] += held.total_prior.equations(optimum).hessian
    unit = hessian.diagonal().clamp(min=1e-300).sqrt()
    values, vectors = torch.linalg.eigh(hessian / unit[:, None] / unit[None, :])
    resolved = values > _RESOLVED * values.max()
    # In these coordinates the curvature is 1 in every direction, of which the noise makes a share.
    basis = vectors[:, resolved] / unit[:, None] / values[resolved].sqrt()
    # The noise is part of the loss: one that would make more was taken for too large. Of a camera
    # that the fit took to the wall both are rounding, of either sign.
    factor = (equations.loss.sum() / excess.loss.sum().clamp(min=1e-300)).clamp(min=0, max=1)
    share, turn = torch.linalg.eigh(basis.T @ (factor * excess.hessian.sum(dim=0)) @ basis)
    basis = basis @ turn
    without = 1 - share.clamp(max=_MOST_OF_CURVATURE)
    return basis @ ((basis.T @ (factor * excess.gradient.sum(dim=0))) / without)


def _expected(
    problem: Problem, core: Core, weighting: PixelWeights | None, noise: DistanceNoise
) -> ImageMoments:
    """Return what the noise adds to the moments, estimated from some frames and pixels."""
    dataset, frames = problem.dataset, problem.frames
    _, design = build_model(dataset, core.options, problem.domain)
    places = [0, *(1 + core.moments.symbols.index(symbol) for symbol in design.symbols)]
    entries = torch.tensor([3 * place + axis for place in places for axis in range(3)])
    count = max(_FEWEST_FRAMES, _PIXELS // dataset.ray_directions()[..., 0].numel())
    count = min(count, len(frames))
    chosen = np.unique(np.linspace(0, len(frames) - 1, count).astype(int))
    gram, number = torch.zeros_like(core.moments.gram), iter(chosen.tolist())
    for batch in dataset.batches(frames[chosen]):
        weights = _weights(weighting, batch)
        for k in range(len(batch.radial_distance)):
            assert batch.amplitude is not None
            valid = batch.valid[k].nonzero()
            some = valid[:: max(1, len(valid) * len(chosen) // _PIXELS)].unbind(1)
            own = _of_pixels(design, batch.radial_distance[k][some], batch.amplitude[k][some], some)
            variance = noise.variance(batch.amplitude[k][some]).clamp(max=_MOST_VARIANCE)
            variance = variance * weights[k][some]
            share = len(valid) / max(len(some[0]), 1) * len(frames) / len(chosen)
            place = next(number)
            gram[place, entries[:, None], entries] = share * (own * variance) @ own.T
    return replace(core.moments, gram=gram)


def _weights(weights: PixelWeights | None, batch: FrameBatch) -> Tensor:
    """Return the weight of each pixel in the fit, shape (B, H, W)."""
    return torch.ones_like(batch.radial_distance) if weights is None else weights(batch)


def _of_pixels(
    design: Design, distance: Tensor, amplitude: Tensor, at: tuple[Tensor, ...]
) -> Tensor:
    """Return the derivatives of the columns with their rays by the distance, (3 C, M)."""
    near, far = (design.signal_functions(distance + h, amplitude) for h in (-_STEP, _STEP))
    slope = ((far - near) / (2 * _STEP))[design.signal]
    columns = slope * design.pixel_functions[:, *at][design.pixel]
    return (columns[:, None, :] * design.ray_directions[at].T).flatten(0, 1)
