"""The gap in millimetres: what it may not depend on."""

import numpy as np
import pytest
import torch
from diagnosed_recordings import TIME, measured, recorded
from diagnosis.resamples import resamples_of

from tofcorr.diagnosis.findings.gap import measure_gap, resampled, squared_gaps, studentised
from tofcorr.diagnosis.findings.naming import NamedEffects, name_effects
from tofcorr.diagnosis.findings.structure import noise_floor
from tofcorr.diagnosis.findings.where import interval_of
from tofcorr.diagnosis.report.result import DiagnosisResult
from tofcorr.diagnosis.sums.base import BaseFit
from tofcorr.diagnosis.sums.study import Study


@pytest.fixture(scope="module")
def true_noise(
    tmp_path_factory: pytest.TempPathFactory, time_study: Study, nothing_study: Study
) -> list[float]:
    """Return the noise that the simulator drew, root mean square of each study, metres."""
    folder, sizes = tmp_path_factory.mktemp("without_noise"), []
    effects = [TIME]
    for study, seed, missing in ((time_study, 32, effects), (nothing_study, 31, [])):
        ideal = recorded(folder / str(seed), seed, missing, noise=False)
        images = measured(ideal).reshape(len(ideal.frames), -1)
        seen = study.observations
        noise = seen.measured - images[seen.frame, seen.pixel]
        sizes.append(float((study.fit.share * noise**2).sum() / study.fit.share.sum()) ** 0.5)
    return sizes


@pytest.mark.slow
def test_a_noise_known_to_a_per_cent_or_two_does_not_change_the_gap(
    time_study: Study,
    nothing_study: Study,
    true_noise: list[float],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Of the true noise: an estimate may be off by most of what the floor allows already."""
    for study, noise in zip((time_study, nothing_study), true_noise, strict=True):
        gaps = []
        for factor in (1.0, 0.98, 1.01):
            known = factor * noise
            monkeypatch.setattr(BaseFit, "floor", property(lambda _, known=known: known))
            gaps.append(measure_gap(study, name_effects(study), resamples_of(study)))
        for gap in gaps[1:]:
            assert gap.before == pytest.approx(gaps[0].before, rel=1e-6)
            assert gap.after == pytest.approx(gaps[0].after, rel=1e-6)


def test_a_floor_is_no_larger_than_what_is_left_inside_images(
    time_study: Study, time_named: NamedEffects, monkeypatch: pytest.MonkeyPatch
) -> None:
    """However large the noise is said to be, here by half too large."""
    known = BaseFit.floor.func  # type: ignore[attr-defined]
    monkeypatch.setattr(BaseFit, "floor", property(lambda fit: 1.5 * known(fit)))
    left, share = time_named.study.residual_of(time_named.columns), time_study.fit.share
    whole = float((share * left**2).sum() / share.sum()) ** 0.5
    assert 0.95 * whole < noise_floor(time_named).size <= whole


def test_parts_of_the_gap_add_up_in_squares(time_diagnosis: DiagnosisResult) -> None:
    gap = time_diagnosis.gap
    parts = (gap.between_images, gap.fixed_pattern, gap.within_images)
    assert sum(part**2 for part in parts) == pytest.approx(gap.before**2, rel=1e-6)


def test_resamples_scatter_around_the_gap_of_all_poses(time_diagnosis: DiagnosisResult) -> None:
    gap = time_diagnosis.gap
    assert np.median(gap.before.draws) == pytest.approx(gap.before, rel=0.05)
    assert np.median(gap.after.draws) == pytest.approx(gap.after, abs=3e-4)


def test_no_gap_is_larger_than_what_is_left_with_the_noise(
    time_study: Study, time_named: NamedEffects
) -> None:
    """However little is known of the floor: it is not below zero."""
    known = noise_floor(time_named)
    sure, unsure = (
        squared_gaps(time_study, time_named, floor, resamples_of(time_study))
        for floor in (
            known._replace(error=0.0, structure=0.0),
            known._replace(error=9 * known.size**2, structure=9 * known.size**2),
        )
    )
    assert (unsure - sure).max() == pytest.approx(known.size**2)
    assert (unsure - sure).min() < -(known.size**2)


def test_intervals_from_a_few_poses_hold_the_mean_square_of_many() -> None:
    """Of eight squares of normal values, percentiles of the resampled means hold it in 76 %."""
    random, generator = np.random.default_rng(2), torch.Generator().manual_seed(3)
    resamples, held = resampled(8, 200, generator), []
    for squares in torch.from_numpy(random.normal(size=(200, 8)) ** 2):
        draws = studentised(squares, torch.ones(8).double(), resamples)
        low, high = interval_of(draws.tolist(), float(squares.mean()))
        held.append(low < 1 < high)
    assert np.mean(held) > 0.85


def test_units_of_one_ratio_leave_no_doubt_of_it() -> None:
    count = torch.tensor([1.0, 2.0, 5.0], dtype=torch.float64)
    resamples = resampled(3, 20, torch.Generator().manual_seed(3))
    found = studentised(3 * count, count, resamples)
    torch.testing.assert_close(found, torch.full_like(found, 3.0))
