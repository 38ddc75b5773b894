"""Whether a model lacks an error, and how far that may move the hand-eye transform.

Every probe is fitted beside the model's unknowns, and beside finer errors over distance, pixel and
amplitude, in one linear step. It counts if leaving out poses says that it is there, and if the
hand-eye transform would leave its stated interval with it.
"""

import numpy as np
import torch
from torch import Tensor

from tofcorr.estimation.further_unknowns import FurtherUnknowns, Moved
from tofcorr.estimation.objective import NormalEquations
from tofcorr.estimation.student import student_quantile
from tofcorr.fit.misfit.found import Misfit
from tofcorr.fit.misfit.pixels import MisfitPixels, misfit_pixels
from tofcorr.fit.misfit.probes import Probe, finer_forms, probes
from tofcorr.fit.result import Fit
from tofcorr.pixels.dataset import Dataset

# Probability that any probe is taken for real where there is nothing, over all probes (Bonferroni).
# Chosen: the customary 5 %; the sizes that are asked for as well make it far less.
_LEVEL = 0.05
# Coverage of the interval that the hand-eye transform must leave: that of the report.
_COVERAGE = 0.95
# Largest error that a probe may stand for, root mean square, metres: 50 mm. Chosen: what is larger
# is no error of a camera, but two unknowns of opposite signs.
_LARGEST = 0.05
# Least shift of the hand-eye transform, metres or radians, that is reported: 1 mm or 1 mrad.
# Chosen: no error of a usual camera is smaller.
_LEAST = 1e-3
# Fewest poses. Chosen: each determines about three of the thirty unknowns, and the scatter between
# poses must be known beside them.
_FEWEST_POSES = 16


def find_misfit(data: Dataset, fit: Fit, frames: np.ndarray) -> Misfit | None:
    """Look for an error that a fitted model lacks and that matters to the hand-eye transform.

    Args:
        data: The recordings, with the walls of the fit.
        fit: The fitted model.
        frames: Global numbers of the frames, fitted or held out, increasing.

    Returns:
        The least likely to be chance of those that would move the transform out of its interval;
        None where there is none, too few poses, or where the transform is not estimated.
    """
    if not fit.solution.parameters.hand_eye_is_free:
        return None
    poses = np.unique(data.pose_groups()[frames])
    if len(poses) < _FEWEST_POSES:
        return None
    seen = misfit_pixels(data, fit, frames)
    half = student_quantile((1 + _COVERAGE) / 2, fit.covariance.degrees_of_freedom)
    half = half * fit.hand_eye_covariance.diagonal().clamp(min=0).sqrt()
    finer, others = finer_forms(seen), probes(seen)
    found = [*_fitted(seen, fit, finer, []), *_fitted(seen, fit, others, finer)]
    # As many probes as were tried, so much likelier is it that chance looks like one of them.
    judged = [
        Misfit(probe.name, probe.trace, min(1.0, len(found) * moved.p_value), moved.shift[:6])
        for probe, moved in found
    ]
    counting = [
        one
        for one in judged
        if one.p_value < _LEVEL
        and bool((one.twist.abs() > half).any())
        and max(one.shift, one.turn) > _LEAST
    ]
    return min(counting, key=lambda one: one.p_value, default=None)


def _fitted(
    seen: MisfitPixels, fit: Fit, tried: list[Probe], beside: list[Probe]
) -> list[tuple[Probe, Moved]]:
    """Fit each probe beside the model and all of some others; those that tell nothing are left out.

    Their values are root mean squares of the errors that they stand for.
    """
    nuisances = [_unit(seen, one.columns(seen)) for one in beside]
    columns = [_unit(seen, one.columns(seen)) for one in tried]
    known = torch.cat([seen.jacobian, *nuisances], dim=1)
    products = _sums(seen, torch.cat([known, *columns, seen.residual[:, None]], dim=1))
    compared = FurtherUnknowns(products, _prior(seen, fit, known.shape[1]))
    found, first = [], 0
    for probe, own in zip(tried, columns, strict=True):
        moved = compared(list(range(first, first + own.shape[1])))
        first += own.shape[1]
        if moved is not None and float(moved.values.abs().max()) < _LARGEST:
            found.append((probe, moved))
    return found


def _unit(seen: MisfitPixels, columns: Tensor) -> Tensor:
    """Scale columns to a root mean square error of the distance of 1."""
    size = (columns / seen.cosine[:, None]).square().mean(dim=0).sqrt()
    return columns / size.clamp(min=1e-12)


def _sums(seen: MisfitPixels, columns: Tensor) -> Tensor:
    """Return the weighted sums of products of the columns over each pose, shape (G, S, S)."""
    weighted = columns * seen.weight.clamp(min=0).sqrt()[:, None]
    order = seen.pose[seen.frame].argsort(stable=True)
    counts = torch.bincount(seen.pose[seen.frame], minlength=int(seen.pose.max()) + 1).tolist()
    return torch.stack([own.T @ own for own in weighted[order].split(counts)])


def _prior(seen: MisfitPixels, fit: Fit, unknowns: int) -> NormalEquations:
    """Return the prior of the fit for all unknowns, by the share of the weight that was read."""
    gradient = torch.zeros(unknowns, dtype=torch.float64)
    hessian = torch.zeros(unknowns, unknowns, dtype=torch.float64)
    if fit.total_prior is not None:
        own = fit.total_prior.equations(fit.solution.parameters)
        share = seen.weight.sum() / fit.moments.gram[:, -1, -1].sum()
        size = len(own.gradient)
        gradient[:size], hessian[:size, :size] = share * own.gradient, share * own.hessian
    return NormalEquations(torch.zeros((), dtype=torch.float64), gradient, hessian)
