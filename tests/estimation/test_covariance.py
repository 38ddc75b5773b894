"""The jackknife's one Newton step is what leaving an image out really does."""

import pytest
import torch
from synthetic_scene import EA, make_scene
from torch import Generator

from tofcorr.errors import CalibrationDataError
from tofcorr.estimation.moments import MomentObjective, Parameters
from tofcorr.estimation.solvers import minimise
from tofcorr.estimation.uncertainty import jackknife_covariance
from tofcorr.geometry import se3


def step_between(origin: Parameters, end: Parameters) -> torch.Tensor:
    between = se3.inverse(origin.tool_from_camera) @ end.tool_from_camera
    return torch.cat([se3.log(between), end.coefficients - origin.coefficients])


def relative_gap(noise: float) -> float:
    """Return how far the jackknife is from refitting, relative to the shifts, in their metric."""
    scene = make_scene(Generator().manual_seed(0), EA, noise=noise)
    moments = scene.moments()
    optimum = minimise(MomentObjective(moments), scene.truth).parameters
    refits = []
    for left_out in range(len(moments.gram)):
        rest = moments.images([k for k in range(len(moments.gram)) if k != left_out])
        refits.append(step_between(optimum, minimise(MomentObjective(rest), optimum).parameters))
    shifts, covariance = torch.stack(refits), jackknife_covariance(moments, optimum)
    scale = covariance.matrix.diagonal().sqrt()
    return float(((covariance.jackknife - shifts) / scale).norm() / (shifts / scale).norm())


def test_the_jackknife_is_leaving_out_each_image_in_turn() -> None:
    # One Newton step leaves an error of second order in the noise: relative to the shift it is
    # of first order, so a tenth of the noise leaves a tenth of the gap.
    gap, gap_at_a_tenth = relative_gap(0.003), relative_gap(0.0003)
    assert gap < 0.02
    assert gap_at_a_tenth < 0.2 * gap


def test_the_scatter_over_new_noise_is_what_the_standard_errors_say(generator: Generator) -> None:
    """Independent of any formula: draw the noise anew and look."""
    ends = []
    for _ in range(40):
        scene = make_scene(generator, EA, num_frames=20)
        moments = scene.moments()
        optimum = minimise(MomentObjective(moments), scene.truth).parameters
        standard_errors = jackknife_covariance(moments, optimum).matrix.diagonal().sqrt()
        ends.append(step_between(scene.truth, optimum) / standard_errors)
    # 40 draws of 14 parameters: the mean square of t variables of 19 degrees of freedom is
    # 19 / 17, give or take a tenth.
    assert 0.8 < float(torch.stack(ends).square().mean()) < 1.7


def test_two_poses_are_too_few() -> None:
    scene = make_scene(Generator().manual_seed(0), EA, num_frames=2)
    with pytest.raises(CalibrationDataError, match="at least 3 poses, got 2"):
        jackknife_covariance(scene.moments(), scene.truth)
