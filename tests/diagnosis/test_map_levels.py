"""Maps of the image: tested beside poses that scatter, estimated whatever their size and shape."""

from dataclasses import replace

import pytest
import torch

from tofcorr.diagnosis.findings.effect_comparison import (
    EffectTest,
    compare_effects,
    left_out_residual,
)
from tofcorr.diagnosis.sums.gains import FittedMap, HeldOutSquares
from tofcorr.diagnosis.sums.study import (
    Study,
    with_poses_reestimated,
    with_residual,
    without_map,
)


def test_poses_that_scatter_leave_no_pattern_in_the_image(nothing_study: Study) -> None:
    """Whether they scatter by millimetres does not change how often noise passes for a map."""
    generator = torch.Generator().manual_seed(3)
    units, pixels = nothing_study.system.sums.num_units, len(nothing_study.fit.sigma)
    own = 3e-3 * torch.randn(units, 3, generator=generator, dtype=torch.float64)
    noise = 0.05 * nothing_study.fit.sigma
    noise = noise * torch.randn(pixels, generator=generator, dtype=torch.float64)
    study = with_residual(nothing_study, nothing_study.pose_surface(own) + noise)
    study = with_poses_reestimated(study, ())
    residual = study.system.residual_of((), gls=True)
    left_out = left_out_residual(study, (), study.sums.gls)
    for name, effect in study.candidates.maps.items():
        found = FittedMap(study, effect, residual)
        gain, null = found.gain(), found.null(left_out)
        test = EffectTest(name=name, closed=gain, gain=float(gain.sum()), null=null, size=1)
        assert test.p_value > 0.05, name


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
    residual = study.system.residual_of((), gls=True)
    values = FittedMap(study, study.candidates.maps["fixed_pattern"], residual).values
    assert float(residual @ values / (values @ values)) == pytest.approx(1, abs=0.1)
    noise = float(study.fit.sigma.square().mean())
    left = float((residual - values).square().mean())
    assert left < noise + 0.02 * float(residual.square().mean())


def test_the_values_of_a_map_do_not_depend_on_what_neighbours_share(nothing_study: Study) -> None:
    study = _with_ring(nothing_study, 0.005)
    residual = study.system.residual_of((), gls=True)
    sums = replace(study.sums, dispersion=40.0)
    other = replace(study, system=replace(study.system, sums=sums))
    effect = study.candidates.maps["fixed_pattern"]
    one, two = (FittedMap(each, effect, residual).values for each in (study, other))
    # The poses' offsets are a little less certain.
    assert float((one - two).norm() / one.norm()) < 0.05


def test_a_map_closes_what_the_model_leaves_when_fitted_again_without_it(
    nothing_study: Study,
) -> None:
    study = _with_ring(nothing_study, 0.005)
    found = compare_effects(study, ("wiggling",), flips=False)
    residual = study.system.residual_of(("wiggling",), gls=True)
    values = FittedMap(study, study.candidates.maps["fixed_pattern"], residual).values
    without = without_map(study, values, {"fixed_pattern"}).system.sums
    left = HeldOutSquares(without.ols, ("wiggling",), study.folds).squares
    torch.testing.assert_close(found.tests["fixed_pattern"].closed, found.squares - left)
