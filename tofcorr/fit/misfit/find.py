"""Whether a model lacks an error, and how far that may move the hand-eye transform.

Every probe is fitted beside the model's unknowns, and beside finer errors over distance, pixel and
amplitude, in one linear step. It counts if leaving out poses says that it is there, and if the
hand-eye transform would leave its stated interval with it.
"""

import torch
from torch import Tensor

from tofcorr.estimation.linear import Added, AddedColumns, pose_products
from tofcorr.estimation.statistics import student_quantile
from tofcorr.fit.misfit.found import Misfit
from tofcorr.fit.misfit.pixels import MisfitPixels
from tofcorr.fit.misfit.prior_share import prior_by_share
from tofcorr.fit.misfit.probes import Probe, finer_forms, probes
from tofcorr.fit.result import Fit

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


def find_misfit(seen: MisfitPixels, fit: Fit) -> Misfit | None:
    """Look for an error that a fitted model lacks and that matters to the hand-eye transform.

    Args:
        seen: Some pixels of the frames, fitted or held out, beside the fitted model.
        fit: The fitted model, its hand-eye transform estimated.

    Returns:
        The least likely to be chance of those that would move the transform out of its interval.
        Finer errors over distance, pixel and amplitude come last: all others stand beside them.
        None where there is none, or too few poses.
    """
    if len(seen.pose.unique()) < _FEWEST_POSES:
        return None
    half = student_quantile((1 + _COVERAGE) / 2, fit.covariance.degrees_of_freedom)
    half = half * fit.hand_eye_covariance.diagonal().clamp(min=0).sqrt()
    finer, others = finer_forms(seen), probes(seen)
    groups = _fitted(seen, fit, others, finer), _fitted(seen, fit, finer, [])
    # As many probes as were tried, so much likelier is it that chance looks like one of them.
    tried = sum(len(group) for group in groups)
    for group in groups:
        judged = [
            Misfit(probe.name, probe.trace, min(1.0, tried * moved.p_value), moved.shift[:6])
            for probe, moved in group
        ]
        counting = [
            one
            for one in judged
            if one.p_value < _LEVEL
            and bool((one.twist.abs() > half).any())
            and max(one.shift, one.turn) > _LEAST
        ]
        if counting:
            return min(counting, key=lambda one: one.p_value)
    return None


def _fitted(
    seen: MisfitPixels, fit: Fit, tried: list[Probe], beside: list[Probe]
) -> list[tuple[Probe, Added]]:
    """Fit each probe beside the model and all of some others; those that tell nothing are left out.

    Their values are root mean squares of the errors that they stand for.
    """
    nuisances = [_unit(seen, one.columns(seen)) for one in beside]
    columns = [_unit(seen, one.columns(seen)) for one in tried]
    known = torch.cat([seen.jacobian, *nuisances], dim=1)
    every = torch.cat([known, *columns, seen.residual[:, None]], dim=1)
    products = pose_products(every, seen.pose[seen.frame], seen.weight.clamp(min=0))
    compared = AddedColumns(products, prior_by_share(seen, fit, known.shape[1]))
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
