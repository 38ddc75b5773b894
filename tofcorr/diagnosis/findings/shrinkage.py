r"""How far the prior of the effects may have moved a share.

Where two effects vary alike, the data say what both add together, and their prior says how they
share it: in equal parts, whichever of them it is. A resample of the poses repeats that, so it shows
nothing of it. With normal equations A of the data and prior precision P, the fitted coefficients
lie

.. math:: -C P \theta, \qquad C = (A + P)^{-1} ,

beside the true ones. As the prior has it, theta has the covariance 1 / P, so that the error has
the covariance C P C: small where the data determine an effect, and that of the prior where they do
not.
"""

import torch

from tofcorr.diagnosis.findings.parts import Parts, Refitted
from tofcorr.diagnosis.findings.resamples import TWO_SIDED


def shrinkage_of_values(parts: Parts, refitted: Refitted) -> list[float]:
    """Return by how much the prior may have moved the value of each cause, 95 %, m^2.

    Args:
        parts: What each cause contributes.
        refitted: The same, fitted to all poses.
    """
    gram, _, prior = parts.fitted
    covariance = torch.linalg.inv(gram.sum(0) + prior)
    covariance = covariance @ prior @ covariance
    fitted = len(covariance)
    # Every part has mean zero but that of the constant, which the data determine.
    means = refitted.means
    centred = refitted.products - means[:, None] * means
    inner, right = centred[:-1, :-1], centred[:-1, -1]
    rest = 2 * right - inner @ refitted.coefficients.sum(0)
    widths = []
    for cause, own in zip(parts.causes, refitted.coefficients, strict=True):
        slope = -inner @ own
        members = list(cause.members)
        slope[members] += rest[members]
        slope = slope[:fitted]
        widths.append(TWO_SIDED * float((slope @ covariance @ slope).clamp(min=0).sqrt()))
    return widths
