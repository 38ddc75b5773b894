"""Probabilities of models: closed forms against distributions, and what each part of them does."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.stats import multivariate_normal, norm
from torch import Tensor

from tofcorr.diagnosis.findings.naming import NamedEffects
from tofcorr.diagnosis.findings.probability import Beside, Evidence, Model, Models, Search
from tofcorr.diagnosis.sums.study import Study, absorbed_share, signal, with_residual
from tofcorr.simulation.effects import CATALOGUE


def _density(study: Study, sizes: dict[str, float], unit: int, prior: Tensor) -> float:
    """Return the log density of a pose given all others, pixel by pixel."""
    columns = torch.cat(study.columns_of(list(sizes)), dim=1)
    known, spread = study.residual, study.sums.pose_sd.diag() ** 2
    precision, right = prior.clone(), torch.zeros(len(prior), dtype=torch.float64)
    parts = []
    for number in range(study.sums.num_units):
        own = study.unit_of_pixel == number
        turns = study.pose[own]
        covariance = (1 / study.weight[own]).diag() + turns @ spread @ turns.T
        parts.append((columns[own], known[own], covariance))
        if number != unit:
            solved = torch.linalg.solve(covariance, columns[own])
            precision += columns[own].T @ solved
            right += solved.T @ known[own]
    mean, uncertain = torch.linalg.solve(precision, right), torch.linalg.inv(precision)
    new, seen, covariance = parts[unit]
    whole = covariance + new @ uncertain @ new.T
    return float(multivariate_normal((new @ mean).numpy(), whole.numpy()).logpdf(seen.numpy()))


def test_densities_are_those_of_the_normal_distribution(time_study: Study) -> None:
    """Up to what all models have in common."""
    evidence, unit = Evidence(time_study), 7
    layout, ols = time_study.sums.layout, time_study.sums.ols
    found, expected = [], []
    models: tuple[dict[str, float], ...] = ({}, {"integration_time": 4e-3})
    for sizes in models:
        prior = layout.prior_of(layout.of(list(sizes))).clone()
        for name, (low, high) in layout.only(list(sizes)).effects.items():
            left = 1 - absorbed_share(time_study, name)
            pixels = ols.scale * float(time_study.sums.count.sum())
            unit_size = (signal(time_study, name) * max(left, 1 / 25) / pixels) ** 0.5
            prior[low:high, low:high] = (unit_size / sizes[name]) ** 2 * torch.eye(high - low)
        found.append(float(Beside(evidence, sizes).density[unit]))
        expected.append(_density(time_study, sizes, unit, prior))
    assert found[1] - found[0] == pytest.approx(expected[1] - expected[0], rel=1e-3)


def test_the_temperature_is_the_variance_of_the_scores(nothing_study: Study) -> None:
    """One where poses depart by pixel noise, four where by twice as much."""
    generator = torch.Generator().manual_seed(8)
    sums = replace(nothing_study.sums, dispersion=1.0)
    study = replace(nothing_study, sums=sums)
    deviation = study.weight.clamp(min=1e-12) ** -0.5
    noise = deviation * torch.randn(len(deviation), generator=generator, dtype=torch.float64)
    own = sums.pose_sd * torch.randn(sums.num_units, 3, generator=generator).double()
    temperatures = []
    for factor in (1.0, 2.0):
        drawn = with_residual(study, factor * (noise + study.pose_surface(own)))
        known = replace(drawn.sums, dispersion=1.0, pose_sd=sums.pose_sd)
        drawn = replace(drawn, sums=known)
        temperatures.append(Evidence(drawn).temperature({}))
    assert temperatures[0] == pytest.approx(1, abs=0.4)
    assert temperatures[1] == pytest.approx(4 * temperatures[0], rel=0.5)


POSES = 40


def _models(gains: dict[Model, float], *, scatter: float = 0.0, odds: float = 0.01) -> Models:
    """Return models that gain so much over the base model, the same in every pose or not."""
    each = torch.ones(POSES, dtype=torch.float64) / POSES
    turns = scatter * torch.randn(POSES, generator=torch.Generator().manual_seed(2)).double()
    densities = [gain * each + (gain != 0) * (turns - turns.mean()) for gain in gains.values()]
    return Models(
        models=tuple(gains),
        densities=torch.stack(densities),
        sizes=tuple({} for _ in gains),
        price=-math.log(odds),
    )


def _posterior(models: Models) -> dict[Model, float]:
    generator = torch.Generator().manual_seed(3)
    weights = torch.empty(2000, POSES).exponential_(generator=generator).double()
    weights *= POSES / weights.sum(1, keepdim=True)
    posterior = models.posterior(weights, generator).mean(1).tolist()
    return dict(zip(models.models, posterior, strict=True))


def test_without_evidence_the_prior_odds_remain() -> None:
    found = _posterior(_models({(): 0.0, ("lens",): 0.0, ("pixel",): 0.0, ("lens", "pixel"): 0.0}))
    assert sum(found.values()) == pytest.approx(1)
    assert found["lens",] / found[()] == pytest.approx(0.01)
    assert found["lens", "pixel"] / found[()] == pytest.approx(1e-4)


def test_evidence_multiplies_the_odds() -> None:
    """A map has no form error, and poses that gain alike leave no doubt which were recorded."""
    gain = math.log(200)
    found = _posterior(_models({(): 0.0, ("fixed_pattern",): gain}))
    assert found["fixed_pattern",] / found[()] == pytest.approx(2)


def test_poses_that_disagree_leave_doubt() -> None:
    sure, unsure = (
        _posterior(_models({(): 0.0, ("fixed_pattern",): 9.0}, scatter=scatter))
        for scatter in (0.0, 1.5)
    )
    assert unsure["fixed_pattern",] < sure["fixed_pattern",] - 0.1


@pytest.mark.parametrize("rival", ["incidence_angle", "row_column_pattern"])
def test_a_rival_remains_as_far_as_its_form_may_fall_short(rival: str) -> None:
    """Of 1000 nats it misses 50: no form error of a map, but half of the draws of an effect."""
    found = _posterior(_models({(): 0.0, ("wiggling",): 1000.0, (rival,): 950.0}))
    share = found[rival,] / (found[rival,] + found["wiggling",])
    expected = 0.0
    if rival == "incidence_angle":
        random = np.random.default_rng(1)
        square = CATALOGUE[rival].form_error ** 2 * random.standard_normal(100_000) ** 2
        reach = np.clip(square * 950, 0, 50)
        expected = float((np.exp(reach - 50) / (1 + np.exp(reach - 50))).mean())
    assert share == pytest.approx(expected, abs=0.02)


def test_a_form_error_of_one_effect_makes_no_other_effect_probable() -> None:
    """What the best model misses may be its form: no reason to add anything to it."""
    more: dict[Model, float] = {("wiggling", name): 1000.5 for name in ("gloss", "lens", "pixel")}
    found = _posterior(_models({(): 0.0, ("wiggling",): 1000.0, **more}))
    assert found["wiggling",] > 0.9


def test_a_second_effect_is_named_for_what_the_form_of_the_first_cannot_be() -> None:
    """It adds 50 of 1050 nats, and is there unless the form error of the first is as large."""
    found = _posterior(_models({(): 0.0, ("wiggling",): 1000.0, ("lens", "wiggling"): 1050.0}))
    least = math.sqrt(50 / 1000) / CATALOGUE["wiggling"].form_error
    assert found["lens", "wiggling"] == pytest.approx(2 * (norm.cdf(least) - 0.5), abs=0.03)


def test_a_form_error_names_nothing_where_there_is_no_signal() -> None:
    found = _posterior(_models({(): 0.0, **{(name,): 2.0 for name in ("lens", "pixel", "gloss")}}))
    assert found[()] > 0.7


def test_the_best_model_of_a_study_is_found_whatever_the_order(time_study: Study) -> None:
    models = Search(Evidence(time_study), 0.001, 2).models()
    assert models.best()[0] == ("integration_time",)


def test_what_is_said_of_one_recording_agrees(
    nothing_named: NamedEffects, time_named: NamedEffects
) -> None:
    """Names are probable, sets hold them, and nothing is more probable than that anything is."""
    for named in (nothing_named, time_named):
        assert float(named.probability.sum()) == pytest.approx(1)
        assert all(own <= named.anything + 1e-12 for own in named.probabilities.values())
        for name, members in named.sets.items():
            assert next(iter(members)) == name
            assert sum(members.values()) <= 1 + 1e-12
            together = named.probability_of_any(*members)
            assert together > named.study.options.tests.named_from
            assert together <= sum(named.probabilities[one] for one in members) + 1e-12
    assert time_named.names == ("integration_time",)
    assert nothing_named.anything < 0.5
