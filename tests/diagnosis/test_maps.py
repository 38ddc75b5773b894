"""Maps of the image are estimated whatever their size and shape."""

from dataclasses import replace

import pytest
import torch

from tofcorr.diagnosis.sums.study import FittedMap, Study, with_poses_reestimated, with_residual


def _with_ring(study: Study, size: float) -> Study:
    """The study with a smooth ring in every image, of that height in metres, and noise."""
    radius = (study.inputs.columns**2 + study.inputs.rows**2).sqrt()
    ring = torch.exp(-0.5 * ((radius - 0.7) / 0.15) ** 2)
    noise = torch.randn(len(ring), generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    return with_residual(study, size * ring + study.fit.sigma * noise)


@pytest.mark.parametrize("size", [0.003, 0.03])
def test_a_map_holds_a_smooth_pattern_whatever_its_size(nothing_study: Study, size: float) -> None:
    """The larger it was, the more it once looked like noise that neighbours share."""
    study = with_poses_reestimated(_with_ring(nothing_study, size), ())
    residual = study.residual_of((), gls=True)
    values = FittedMap(study, study.maps["fixed_pattern"], residual).values
    assert float(residual @ values / (values @ values)) == pytest.approx(1, abs=0.1)
    noise = float(study.fit.sigma.square().mean())
    left = float((residual - values).square().mean())
    assert left < noise + 0.02 * float(residual.square().mean())


def test_the_values_of_a_map_do_not_depend_on_what_neighbours_share(nothing_study: Study) -> None:
    study = _with_ring(nothing_study, 0.005)
    residual = study.residual_of((), gls=True)
    other = replace(study, sums=replace(study.sums, dispersion=40.0))
    effect = study.maps["fixed_pattern"]
    one, two = (FittedMap(each, effect, residual).values for each in (study, other))
    # The poses' offsets are a little less certain.
    assert float((one - two).norm() / one.norm()) < 0.05
