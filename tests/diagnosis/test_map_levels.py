"""Maps of the image are tested beside poses that scatter."""

import torch

from tofcorr.diagnosis.findings.effect_comparison import EffectTest
from tofcorr.diagnosis.findings.effect_gains import left_out_residual
from tofcorr.diagnosis.sums.changes import with_poses_reestimated, with_residual
from tofcorr.diagnosis.sums.map_gain import map_gain
from tofcorr.diagnosis.sums.pose_offsets import pose_surface
from tofcorr.diagnosis.sums.study import Study, likely_residual_of


def test_poses_that_scatter_leave_no_pattern_in_the_image(nothing_study: Study) -> None:
    """Whether they scatter by millimetres does not change how often noise passes for a map."""
    generator = torch.Generator().manual_seed(3)
    units, pixels = nothing_study.system.blocks.num_units, len(nothing_study.fit.sigma)
    own = 3e-3 * torch.randn(units, 3, generator=generator, dtype=torch.float64)
    noise = 0.05 * nothing_study.fit.sigma
    noise = noise * torch.randn(pixels, generator=generator, dtype=torch.float64)
    study = with_residual(nothing_study, pose_surface(nothing_study, own) + noise)
    study = with_poses_reestimated(study, ())
    residual = likely_residual_of(study, ())
    left_out = left_out_residual(study, (), study.system.blocks.likely)
    for name, effect in study.candidates.maps.items():
        found = map_gain(study, effect, residual, left_out)
        gain = float(found.gain.sum())
        test = EffectTest(name=name, closed=found.closed, gain=gain, null=found.null, size=1)
        assert test.p_value > 0.05, name
