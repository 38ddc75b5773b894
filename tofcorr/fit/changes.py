r"""Which part of a camera on a robot has changed since its calibration, by a few new frames.

Before the frames are read, the unknowns are believed to be :math:`N(\theta_0, S + C)`: the
posterior of the calibration, and a change of covariance C that each explanation states. Around the
fit that allows every change, the frames say of a step :math:`\delta`, with gradient g and curvature
H of the loss and the effective variance v of a residual,

.. math:: \log p(y \mid \delta) = -\frac{1}{2 v}\, (2 g \cdot \delta + \delta \cdot H \delta)
    + \mathrm{const} ,

so the probability of the frames under an explanation is a Gaussian integral (Laplace). Walls in
unknown places are eliminated before. How large a change is, if there is one, is not known: its
sizes are equally probable steps of a factor of two.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
import torch
from torch import Tensor

from tofcorr.estimation.linear import NormalEquations
from tofcorr.estimation.moments import MomentObjective
from tofcorr.estimation.planes import marginal_hessian
from tofcorr.estimation.uncertainty import effective_variance
from tofcorr.fit.fitting import on_walls, prepare
from tofcorr.fit.known import PriorKnowledge
from tofcorr.fit.problem import FitOptions, Problem
from tofcorr.pixels.dataset import Dataset, Frames
from tofcorr.pixels.lattice import lattice_of

EXPLANATIONS = {
    "nothing": (),
    "mount": ("mount",),
    "temperature": ("temperature",),
    "mount_and_temperature": ("mount", "temperature"),
    "camera": ("mount", "camera"),
}
"""What may have happened, and the parts of the calibration that it changes."""
SIZES = tuple(2.0**k / 1000 for k in range(-1, 7))
"""Standard deviations of a change, metres and radians: from half a millimetre, which nothing that
happens to a camera is worth below, to 64 mm, beyond which no camera is called bumped."""
# Probability, before any frame is read, that nothing changed: as probable as all others together.
_UNCHANGED = 1 / 2
# How much the other coefficients change for what the constant changes. Chosen: the drift of a warm
# camera hardly depends on distance (Kahlmann et al. 2006); units differ most by a constant.
_OF_CONSTANT = {"temperature": 1 / 20, "camera": 1 / 4}


@dataclass(frozen=True)
class Explanation:
    """One explanation of new frames.

    Attributes:
        name: One of `EXPLANATIONS`.
        parts: The parts of the calibration that it changes.
        probability: Of all explanations, given the frames.
        change: Covariance C of the change, shape (P, P), of the most probable size.
        known: What is believed before the frames, under it.
    """

    name: str
    parts: tuple[str, ...]
    probability: float
    change: Tensor
    known: PriorKnowledge


def explain(
    dataset: Dataset,
    frames: Frames,
    options: FitOptions,
    known: PriorKnowledge,
    of_type: PriorKnowledge | None = None,
) -> list[Explanation]:
    """Return the explanations of new frames, the most probable first.

    Args:
        dataset: The recordings, walls in unknown places where they seem to be.
        frames: Global numbers of the frames to look at.
        options: Of the fit; its terms are those of the calibration.
        known: What the calibration knows, on the ranges of the fit.
        of_type: Of other cameras of this type, likewise; None: they may have any errors.

    Raises:
        CalibrationDataError: The frames lack an input of the model.
    """
    widest = {"mount": SIZES[-1], "camera": SIZES[-1]}
    wide = replace(known, covariance=known.covariance + _change(known, widest))
    seen = lattice_of(dataset, frames)
    problem = Problem(dataset, np.asarray(frames), options, known.domain, seen, known=wide)
    moments, _ = prepare(problem)
    problem, core = on_walls(problem, moments, held=False)
    best = core.solution.parameters
    # The frames that tell the scatter of residuals are few: it counts as no less than it was.
    variance = max(known.variance, effective_variance(core.moments, best))
    images = MomentObjective(core.moments).normal_equations(best)
    hessian = marginal_hessian(core.moments, best, problem.estimated)
    data, found = NormalEquations(images.loss, images.gradient, hessian), []
    moves = known.parameters.hand_eye_is_free
    tried = [name for name in EXPLANATIONS if moves or not name.startswith("mount")]
    for name in tried:
        parts = tuple(one for one in EXPLANATIONS[name] if moves or one != "mount")
        sized = [dict(zip(parts, one, strict=True)) for one in product(SIZES, repeat=len(parts))]
        changes = [_change(known, one) for one in sized]
        beliefs = [_believed(known, one, of_type if "camera" in parts else None) for one in changes]
        here = data.at(best.step_to(beliefs[0].parameters))
        covariances = torch.stack([one.covariance for one in beliefs])
        logs = _log_evidence(here, covariances, variance)
        prior = _UNCHANGED if name == "nothing" else (1 - _UNCHANGED) / (len(tried) - 1)
        total = float(logs.logsumexp(0)) + math.log(prior / len(beliefs))
        likely = int(logs.argmax())
        # The mount is anywhere then: only how probable a move is depends on its size. Of what is
        # known of a type nothing does.
        loose = {"mount"} if of_type is None else {"mount", "camera"}
        free = {one: SIZES[-1] for one in parts if one in loose}
        change = changes[likely] + _change(known, free)
        belief = _believed(known, change, of_type if "camera" in parts else None)
        found.append(Explanation(name, parts, total, change, replace(belief, variance=variance)))
    shares = torch.tensor([one.probability for one in found]).softmax(0).tolist()
    found = [replace(one, probability=p) for one, p in zip(found, shares, strict=True)]
    return sorted(found, key=lambda one: -one.probability)


def _change(known: PriorKnowledge, sizes: Mapping[str, float]) -> Tensor:
    """Return the covariance of a change of some parts, each of a size in metres and radians."""
    twist, variances = known.parameters.twist_size, torch.zeros(known.parameters.size).double()
    for part, size in sizes.items():
        if part == "mount":
            variances[:twist] += size**2
        else:
            variances[twist] += size**2
            variances[twist + 1 :] += (_OF_CONSTANT[part] * size) ** 2
    return variances.diag()


def _believed(
    known: PriorKnowledge, change: Tensor, of_type: PriorKnowledge | None
) -> PriorKnowledge:
    """Return what is believed after a change; of another camera of a type, what is known of it."""
    changed = replace(known, covariance=known.covariance + change)
    if of_type is None:
        return changed
    twist = known.parameters.twist_size
    parameters = replace(known.parameters, coefficients=of_type.parameters.coefficients)
    covariance = torch.block_diag(changed.covariance[:twist, :twist], of_type.covariance)
    return replace(changed, parameters=parameters, covariance=covariance)


def _log_evidence(data: NormalEquations, covariances: Tensor, variance: float) -> Tensor:
    """Return the logarithm of the probability of frames under beliefs, up to a constant.

    Args:
        data: What the frames say, around the mean of the beliefs.
        covariances: Of the beliefs, shape (B, P, P).
        variance: Effective variance of a residual.
    """
    root = torch.linalg.cholesky(covariances)
    precision = torch.eye(root.shape[-1]).to(root) + root.mT @ data.hessian @ root / variance
    score = root.mT @ data.gradient / variance
    gain = (score * torch.linalg.solve(precision, score)).sum(dim=1)
    return (gain - torch.logdet(precision) - data.loss / variance) / 2
