"""The prior of a fit beside a sample of its pixels."""

import torch

from tofcorr.estimation.linear import NormalEquations
from tofcorr.fit.misfit.pixels import MisfitPixels
from tofcorr.fit.result import Fit


def prior_by_share(seen: MisfitPixels, fit: Fit, unknowns: int) -> NormalEquations:
    """Return the prior of the fit for all unknowns, by the share of the weight that was read."""
    gradient = torch.zeros(unknowns, dtype=torch.float64)
    hessian = torch.zeros(unknowns, unknowns, dtype=torch.float64)
    if fit.total_prior is not None:
        own = fit.total_prior.equations(fit.solution.parameters)
        share = seen.weight.sum() / fit.moments.gram[:, -1, -1].sum()
        size = len(own.gradient)
        gradient[:size], hessian[:size, :size] = share * own.gradient, share * own.hessian
    return NormalEquations(torch.zeros((), dtype=torch.float64), gradient, hessian)
