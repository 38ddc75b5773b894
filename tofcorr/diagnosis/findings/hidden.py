r"""How much of a share may be hidden in the columns of other causes.

What a model misses of an effect is seen, as the unexplained e, or it is hidden: the columns of
other causes reproduce it. Suppose that as much is hidden as is seen, in a random direction of the
space that K columns span. Its product with the residual c, less its mean, then has the standard
deviation

.. math:: |e| \, |c| / \sqrt{K} .

A base term or the hand-eye transform gains or loses at most that with c projected on its own
columns.
"""

import math

import torch

from tofcorr.diagnosis.findings.parts import Parts, Refitted
from tofcorr.diagnosis.findings.resamples import TWO_SIDED

# Added to the diagonal of a cause's products, as a share of its mean, so that they are regular.
_RIDGE = 1e-9


def hidden_shares(parts: Parts, refitted: Refitted, unexplained: float) -> list[float]:
    """Return by how much each cause's share may be too small or too large, 95 %.

    Args:
        parts: What each cause contributes.
        refitted: The same, fitted to all poses.
        unexplained: The share that is unexplained.
    """
    means, whole = refitted.means, float(refitted.products[-1, -1])
    centred = refitted.products - means[:, None] * means
    square = float(centred[-1, -1])
    if whole <= 0:
        return [0.0] * len(parts.causes)
    reach = TWO_SIDED * math.sqrt(unexplained / (len(means) - 1) / whole)
    widths = []
    for cause in parts.causes:
        known = square
        if cause.kind == "parameter":
            fixed = [] if cause.fixed is None else [cause.fixed]
            own = torch.tensor([*cause.members, *fixed])
            gram, right = centred[own][:, own], centred[own, -1]
            ridge = _RIDGE * gram.diagonal().mean() * torch.eye(len(own), dtype=torch.float64)
            known = min(float(right @ torch.linalg.solve(gram + ridge, right)), square)
        widths.append(reach * math.sqrt(max(known, 0.0)))
    return widths
