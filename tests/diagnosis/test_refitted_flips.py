"""Flips of poses, with the model fitted to them again."""

import torch

from tofcorr.diagnosis.findings.effect_comparison import left_out_residual
from tofcorr.diagnosis.findings.where import find_where, flipped
from tofcorr.diagnosis.sums.study import Study


def test_a_flip_is_the_sum_of_what_a_fit_to_flipped_pixels_leaves(time_study: Study) -> None:
    """Pixel by pixel, with the normal equations written out."""
    study, chosen = time_study, ()
    residual = left_out_residual(study, chosen, study.sums.ols)
    unit, weight = study.unit_of_pixel, study.weight
    flips = flipped(study, residual, chosen, most_pixels=len(residual))
    columns = torch.cat(study.system.of(chosen), dim=1)
    layout, even = study.sums.layout, study.sums.scale
    share = even * study.fit.share[:, None] * columns
    place = (study.inputs.radial_distance > 1.0).long()
    own = torch.zeros(2, study.sums.num_units, dtype=torch.float64)
    own.view(-1).index_add_(0, place * own.shape[1] + unit, weight * residual)
    found = flips(own, place, torch.ones_like(weight))
    normal = share.T @ columns + layout.prior_of(layout.of(chosen))
    for flip in (0, 5):
        turned = study.signs[flip][unit] * residual
        left = turned - columns @ torch.linalg.solve(normal, share.T @ turned)
        expected = torch.zeros(2, dtype=torch.float64).index_add(0, place, weight * left)
        torch.testing.assert_close(found[:, 1 + flip], expected, rtol=1e-6, atol=1e-6 * 1e3)


def test_a_bias_that_the_model_absorbs_hides_none_that_it_does_not(time_study: Study) -> None:
    """An error of the exposure shows along it, and none along what the base model describes."""
    found = find_where(time_study, "recalibrated").by_covariate()
    assert min(region.p_value for region in found["integration_time"]) <= 0.02
    assert min(region.p_value for region in found["row"]) > 0.02
