"""Sums over poses say what passes over the pixels would."""

from collections.abc import Mapping
from dataclasses import replace

import pytest
import torch

from tofcorr.diagnosis.sums.linear_system import BASE, PoseSums, draw_folds, pose_sums
from tofcorr.diagnosis.sums.study import Study, with_residual
from tofcorr.pixels.dataset import thread_number


def _brute_force(study: Study, names: list[str], keep: torch.Tensor) -> torch.Tensor:
    """Fit by least squares over the pixels of the poses kept; return all residuals."""
    members = study.sums.layout.of(names)
    columns = torch.cat(study.columns_of(names), dim=1)
    weight = study.fit.share * keep[study.unit_of_pixel]
    scale = study.sums.scale
    normal = scale * (columns * weight[:, None]).T @ columns
    normal = normal + study.sums.layout.prior_of(members)
    right = scale * (columns * weight[:, None]).T @ study.residual
    return study.residual - columns @ torch.linalg.solve(normal, right)


def _base_prior(study: Study) -> torch.Tensor:
    count = study.columns[BASE].shape[1]
    return study.sums.layout.prior[:count, :count]


def _summed(study: Study, residual: torch.Tensor, columns: Mapping[str, torch.Tensor]) -> PoseSums:
    """Return the sums of a pass over the pixels."""
    fit = replace(study.fit, residual=residual)
    return pose_sums(study.observations, columns, study.pose, fit, _base_prior(study))


def _per_pose(study: Study, residual: torch.Tensor) -> torch.Tensor:
    squares = torch.zeros(study.sums.num_units, dtype=torch.float64)
    return squares.index_add(0, study.unit_of_pixel, study.fit.share * residual**2)


def test_left_out_squares_are_those_of_refits_without_the_pose(time_study: Study) -> None:
    squares = time_study.left_out_squares(["integration_time"])
    for unit in (0, 17):
        keep = torch.ones(time_study.sums.num_units, dtype=torch.float64)
        keep[unit] = 0.0
        residual = _brute_force(time_study, ["integration_time"], keep)
        assert float(squares[unit]) == pytest.approx(float(_per_pose(time_study, residual)[unit]))


def test_folds_hold_every_pose_once() -> None:
    folds = draw_folds(23, 5, torch.Generator().manual_seed(1))
    assert folds.sum(1).tolist() == [5, 5, 5, 4, 4]
    assert torch.equal(folds.sum(0), torch.ones(23, dtype=torch.float64))


def test_another_residual_needs_no_other_sums_than_its_own(nothing_study: Study) -> None:
    other = nothing_study.residual + 1e-3 * nothing_study.inputs.rows
    quick = with_residual(nothing_study, other).sums
    whole = _summed(nothing_study, other, nothing_study.columns)
    torch.testing.assert_close(quick.weighted, whole.weighted, rtol=1e-9, atol=1e-6)
    torch.testing.assert_close(quick.plain, whole.plain, rtol=1e-9, atol=1e-9)


def test_other_columns_need_no_other_sums_than_their_own(nothing_study: Study) -> None:
    study = nothing_study
    changed = {"wiggling": study.columns["wiggling"] * (1 + study.inputs.rows[:, None])}
    quick = with_residual(study, study.residual, ("wiggling",), changed).sums
    whole = _summed(study, study.residual, {**study.columns, **changed})
    torch.testing.assert_close(quick.weighted, whole.weighted, rtol=1e-9, atol=1e-6)
    torch.testing.assert_close(quick.plain, whole.plain, rtol=1e-9, atol=1e-9)


def test_sums_by_two_threads_are_those_of_one_bit_for_bit(time_study: Study) -> None:
    before = torch.get_num_threads()
    found = []
    try:
        for threads in (1, 2):
            torch.set_num_threads(threads)
            with thread_number(1):
                found.append(_summed(time_study, time_study.residual, time_study.columns))
    finally:
        torch.set_num_threads(before)
    assert torch.equal(found[0].weighted, found[1].weighted)
    assert torch.equal(found[0].plain, found[1].plain)
    assert torch.equal(found[0].count, found[1].count)
