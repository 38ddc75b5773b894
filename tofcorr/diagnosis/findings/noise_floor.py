"""The noise that is no gap: its level, how well that is known, and how poses differ in it.

Repeats or neighbouring pixels determine the floor to 5 per cent only, which is as large as a small
gap. Within these 5 per cent, or as much as the estimate of the noise leaves open, the floor is what
the final model leaves, less the variance that pixels, images or poses share. It is never more than
what is left inside images, without the waves that noise does not make.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from tofcorr.diagnosis.findings.coherence import coherence_inside, without_pose
from tofcorr.diagnosis.findings.explained import FLOOR_ERROR
from tofcorr.diagnosis.findings.naming import NamedEffects
from tofcorr.diagnosis.findings.shared_by_poses import shared_by_poses
from tofcorr.diagnosis.findings.waves import unlike_waves
from tofcorr.diagnosis.sums.shared_noise import shared_noise
from tofcorr.diagnosis.sums.study import Study, residual_of

# Waves with at most this p-value are no noise. The usual convention.
_SURE = 0.01


class NoiseFloor(NamedTuple):
    """The noise of a pixel.

    Attributes:
        size: Root mean square, metres.
        error: Standard error of its square, m^2.
        structure: What of its square may be structure, at most, m^2.
    """

    size: float
    error: float
    structure: float


def noise_floor(named: NamedEffects) -> NoiseFloor:
    """Return what the final model leaves and no pixels share, near the known floor."""
    left = residual_of(named.study, named.columns)
    study, (least, most) = _known_noise(named, left)
    own_of_images, between = without_pose(study, left)
    share, structure = study.fit.share, coherence_inside(study, own_of_images, between)
    alike, inside = structure.noise_share, float((share * left**2).sum() / share.sum())
    inside -= max(between, 0.0)
    # Of the noise s^2, pixels share alike s^2; `within` lacks the same share of the known noise.
    shared = structure.within + alike * study.fit.floor**2
    square = (inside - shared) / (1 - alike)
    square = inside - max(shared - alike * max(square, 0.0), structure.fixed, 0.0)
    by_poses = shared_by_poses(study, own_of_images)
    most_noise = inside - by_poses.square
    own = float(np.clip(np.sqrt(max(min(square, most_noise), 0.0)), least, most))
    # That of the known floor (two standard errors to either limit), though `own` scatters less:
    # structure that only single pixels show counts as noise.
    error, hidden = float(np.hypot((most**2 - least**2) / 4, by_poses.error)), 0.0
    waves = unlike_waves(named.study, named.columns)
    if waves.p_value <= _SURE:
        # What poses share may be these waves: the larger of both is structure, not their sum. What
        # made the waves may have made others, which count as noise.
        most_noise, hidden = min(most_noise, inside - waves.square), waves.square
    return NoiseFloor(min(own, max(most_noise, 0.0) ** 0.5), error, hidden)


def _known_noise(named: NamedEffects, left: Tensor) -> tuple[Study, tuple[float, float]]:
    """Return the study, and the least and largest noise of a pixel, metres.

    Without repeats a filter is looked for once more in what the final model leaves: the structure
    that it explains looked like a filter, or hid one.
    """
    study, fit = named.study, named.study.fit
    least, most = fit.noise.least, fit.noise.most
    if named.columns and not fit.shared.from_repeats:
        found = shared_noise(study.observations, left, fit.sigma, fit.trust)
        if study.observations.is_sample:  # Whole images said more of it.
            found = replace(found, level=fit.shared.level)
        study = replace(study, fit=replace(fit, shared=found))
        _, assumed, _ = fit.noise.limits(fit.shared.level)
        least, _, most = (limit / assumed for limit in fit.noise.limits(found.level))
    return study, ((1 - FLOOR_ERROR) * least * fit.floor, (1 + FLOOR_ERROR) * most * fit.floor)


def noise_of_poses(study: Study, floor: float) -> Tensor:
    """Return the sum of the squared noise over the pixels of every pose, with this floor, (U,)."""
    fit, count = study.fit, study.system.blocks.count
    own = torch.zeros_like(count).index_add(0, study.unit_of_pixel, fit.share * fit.sigma**2)
    return (floor / fit.floor) ** 2 * own
