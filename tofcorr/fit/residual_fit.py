"""Decides by cross-validation whether a residual network is kept.

It is kept when images that were held out, pose by pose, are predicted significantly better with it.
"""

from dataclasses import dataclass

import numpy as np
import torch

from tofcorr.error_terms.domain import Domain
from tofcorr.error_terms.residual import ResidualNetwork
from tofcorr.estimation.parameters import Parameters
from tofcorr.estimation.statistics import student_tail
from tofcorr.fit.residual_options import ResidualOptions
from tofcorr.fit.residual_sample import ResidualSample
from tofcorr.fit.residual_training import FittedCore, distance_to_plane, train_network

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
    sample: ResidualSample,
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
    sample: ResidualSample,
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
            for image in torch.unique(held_out.image).tolist():
                target[image] = float(square[held_out.image == image].mean())
    return without, with_network
