"""The gap in resamples of the poses: what its intervals come from.

Each pose is predicted by a fit to all others. To first order a sum of such squares varies only by
the poses that are drawn: the fit is where they are least. So nothing is fitted to a resample, whose
few different poses would predict far worse; but the effects are selected again, or none where none
is large enough. Poses differ in their noise, which is subtracted as it is there.
"""

import numpy as np
import torch
from torch import Tensor

from tofcorr.diagnosis.findings.effect_comparison import compare_effects
from tofcorr.diagnosis.findings.naming import NamedEffects
from tofcorr.diagnosis.findings.noise_floor import NoiseFloor, noise_of_poses
from tofcorr.diagnosis.findings.resamples import studentised
from tofcorr.diagnosis.sums.left_out import LeftOutModel, left_out_model
from tofcorr.diagnosis.sums.study import Study


def squared_gaps(
    study: Study, named: NamedEffects, floor: NoiseFloor, resamples: Tensor
) -> list[tuple[float, float]]:
    """Return squared gaps before and after the effects in every resample, m^2.

    The floor has one error for all squared gaps of a resample, and holds structure in half of them.
    No floor is below zero, so that no gap is larger than what is left.

    Args:
        study: The recording, before any effect was named.
        named: The effects named.
        floor: Noise that is no gap.
        resamples: How often each resample holds each pose, shape (B, U).
    """
    draws = _resampled(study, named, floor.size, resamples)
    random, most = np.random.default_rng(study.options.seed), floor.size**2
    excess = floor.error * random.standard_normal(len(draws))
    excess += min(floor.structure, most) * random.uniform(-1, 1, len(draws)).clip(min=0)
    draws = draws + np.minimum(excess, most)[:, None]
    return [(before, after) for before, after in draws.tolist()]


def squared_gaps_of(study: Study, model: LeftOutModel, floor: float, resamples: Tensor) -> Tensor:
    """Return the squared gap that a model leaves in every resample, with this floor, (B,), m^2."""
    excess = model.squares() - noise_of_poses(study, floor)
    return studentised(excess, model.pose_count, resamples)


def _resampled(study: Study, named: NamedEffects, floor: float, resamples: Tensor) -> np.ndarray:
    """Return squared gaps before and after in every resample, (B, 2), m^2."""
    before = squared_gaps_of(study, left_out_model(study, ()), floor, resamples)
    after = before.clone()
    if named.names or named.refined_terms:
        rivals = _rivals(named)
        chosen = [_chosen_again(named, rivals, weights) for weights in resamples]
        for names in dict.fromkeys(chosen):
            own = torch.tensor([each == names for each in chosen])
            model = left_out_model(named.study, names)
            after[own] = squared_gaps_of(study, model, floor, resamples[own])
    return torch.stack([before, after], dim=1).numpy()


def _rivals(named: NamedEffects) -> dict[str, dict[str, Tensor]]:
    """Return what each named effect and its cause set close in its place, (U,) each."""
    rivals = {}
    for name, members in zip(named.names, named.cause_sets, strict=True):
        if name not in named.study.candidates.effects:
            continue
        others = [n for n in named.columns if n != name]
        tests = compare_effects(named.study, others, flips=False, maps=False).tests
        rivals[name] = {n: test.closed for n, test in tests.items() if n in members}
    return rivals


def _chosen_again(
    named: NamedEffects, rivals: dict[str, dict[str, Tensor]], weights: Tensor
) -> tuple[str, ...]:
    """Select for each named effect the member of its cause set that closes most in a resample.

    None is selected where none closes what an effect must close to be named.
    """
    chosen = [n for n in named.refined_terms if n in named.study.candidates.effects]
    tests, count = named.study.options.tests, named.study.system.blocks.count
    size = tests.material_mm if len(named.names) == 1 else tests.further_mm
    least = (size * 1e-3) ** 2 * float(weights @ count)
    for gains in rivals.values():
        left = {n: float((weights * g).sum()) for n, g in gains.items() if n not in chosen}
        best = max(left, key=lambda n: left[n])
        if left[best] >= least:
            chosen.append(best)
    return tuple(chosen)
