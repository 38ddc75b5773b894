"""The gap in millimetres: what it may not depend on."""

import numpy as np
import pytest
import torch

from tofcorr.diagnosis.findings.how_far import Gap, measure_gap
from tofcorr.diagnosis.findings.naming import NamedEffects, name_effects
from tofcorr.diagnosis.findings.noise_floor import noise_floor
from tofcorr.diagnosis.findings.resamples import draw_resamples
from tofcorr.diagnosis.sums.base_fit import BaseFit
from tofcorr.diagnosis.sums.study import Study, residual_of


def _measured(study: Study) -> Gap:
    resamples = draw_resamples(study, torch.Generator().manual_seed(1))
    return measure_gap(study, name_effects(study), resamples)


@pytest.mark.parametrize("factor", [0.98, 1.01])
@pytest.mark.slow
def test_a_noise_known_to_a_per_cent_or_two_does_not_change_the_gap(
    time_study: Study, nothing_study: Study, factor: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    true = [_measured(study) for study in (time_study, nothing_study)]
    known = BaseFit.floor.func  # type: ignore[attr-defined]
    monkeypatch.setattr(BaseFit, "floor", property(lambda fit: factor * known(fit)))
    for gap, study in zip(true, (time_study, nothing_study), strict=True):
        assert _measured(study).before == pytest.approx(gap.before, rel=1e-6)
        assert _measured(study).after == pytest.approx(gap.after, rel=1e-6)


@pytest.fixture(scope="module")
def time_named(time_study: Study) -> NamedEffects:
    return name_effects(time_study)


@pytest.fixture(scope="module")
def time_gap(time_study: Study, time_named: NamedEffects) -> Gap:
    resamples = draw_resamples(time_study, torch.Generator().manual_seed(1))
    return measure_gap(time_study, time_named, resamples)


def test_a_floor_is_no_larger_than_what_is_left_inside_images(
    time_study: Study, time_named: NamedEffects, monkeypatch: pytest.MonkeyPatch
) -> None:
    """However large the noise is said to be, here by half too large."""
    known = BaseFit.floor.func  # type: ignore[attr-defined]
    monkeypatch.setattr(BaseFit, "floor", property(lambda fit: 1.5 * known(fit)))
    left, share = residual_of(time_named.study, time_named.columns), time_study.fit.share
    whole = float((share * left**2).sum() / share.sum()) ** 0.5
    assert 0.95 * whole < noise_floor(time_named).size <= whole


def test_parts_of_the_gap_add_up_in_squares(time_gap: Gap) -> None:
    parts = (time_gap.between_images, time_gap.fixed_pattern, time_gap.within_images)
    assert sum(part**2 for part in parts) == pytest.approx(time_gap.before**2, rel=1e-6)


def test_resamples_scatter_around_the_gap_of_all_poses(time_gap: Gap) -> None:
    """A fit to a resample predicts worse than one to all poses; that is no part of an interval."""
    assert np.median(time_gap.draws.before) == pytest.approx(time_gap.before, rel=0.05)
    assert np.median(time_gap.draws.after) == pytest.approx(time_gap.after, abs=3e-4)
