"""The gap in resamples of the poses: what its intervals come from.

Each resample refits base model, hand-eye and effects, and selects the effects again,
or none where none is large enough. Poses differ in their noise, which is subtracted as it is there.
"""

import numpy as np
import torch
from torch import Tensor

from tofcorr.diagnosis.findings.effect_comparison import compare_effects
from tofcorr.diagnosis.findings.naming import NamedEffects
from tofcorr.diagnosis.findings.noise_floor import NoiseFloor, noise_of_resamples
from tofcorr.diagnosis.sums.left_out import left_out_model
from tofcorr.diagnosis.sums.study import Study


def squared_gaps(
    study: Study,
    named: NamedEffects,
    floor: NoiseFloor,
    estimates: tuple[float, float],
    resamples: Tensor,
) -> list[tuple[float, float]]:
    """Return squared gaps before and after the effects in every resample, m^2.

    Their medians are the estimates: a resample holds two thirds of the poses, and a fit to fewer
    poses predicts each of them worse. The floor has one error for all squared gaps of a resample.

    Args:
        study: The recording, before any effect was named.
        named: The effects named.
        floor: Noise that is no gap.
        estimates: Squared gaps before and after, from all poses, m^2.
        resamples: How often each resample holds each pose, shape (B, U).
    """
    draws = _resampled(study, named, floor.size, resamples)
    errors = np.random.default_rng(study.options.seed).standard_normal(len(draws))
    draws = draws + np.array(estimates) - np.median(draws, axis=0)
    draws = draws + floor.error * errors[:, None]
    return [(before, after) for before, after in draws.tolist()]


def _resampled(study: Study, named: NamedEffects, floor: float, resamples: Tensor) -> np.ndarray:
    """Return squared gaps before and after in every resample, each fitted anew, (B, 2), m^2."""
    before = left_out_model(study, ()).mean_squares(resamples)
    after = before.clone()
    if named.names or named.refined_terms:
        rivals = _rivals(named)
        chosen = [_chosen_again(named, rivals, weights) for weights in resamples]
        for names in dict.fromkeys(chosen):
            own = torch.tensor([each == names for each in chosen])
            after[own] = left_out_model(named.study, names).mean_squares(resamples[own])
    noise = noise_of_resamples(study, floor, resamples)
    return torch.stack([before - noise, after - noise], dim=1).numpy()


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
