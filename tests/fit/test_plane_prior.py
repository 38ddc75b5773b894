"""Planes that are not known exactly: in the fit, and where held-out images are judged."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from simulated_walls import simulated_wall

from tofcorr.estimation.moments import ImageMoments, MomentObjective, Parameters
from tofcorr.estimation.planes import within_prior
from tofcorr.estimation.solvers import minimise
from tofcorr.geometry.rays import plane_moves, plane_precision
from tofcorr.pixels.dataset import Dataset, recorded_hand_eye
from tofcorr.pixels.lattice import covered_domain
from tofcorr.pixels.passes import frame_errors, views_mm
from tofcorr.training.calibration import without_correction


def test_planes_within_their_prior_are_generalised_least_squares(
    generator: torch.Generator,
) -> None:
    def drawn(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    # Three images of five pixels, whose planes are about 1.2 m away; a constant error alone.
    ray = torch.nn.functional.normalize(drawn(3, 5, 3) + torch.tensor([0, 0, 4.0]), dim=-1)
    normal = torch.nn.functional.normalize(0.3 * drawn(3, 3) - torch.tensor([0, 0, 1.0]), dim=1)
    gain, noise = (ray * normal[:, None]).sum(-1), 1e-3
    distance = -1.2 / gain + 0.02 + noise * drawn(3, 5)
    one = torch.ones(3, 5, 1, dtype=torch.float64)
    columns = torch.cat([distance[..., None] * ray, ray, one], dim=2)
    offset, count = torch.full((3,), 1.2).double(), torch.full((3,), 5.0).double()
    moments = ImageMoments(columns.mT @ columns, normal, offset, count, ["c0"])
    at = Parameters(torch.eye(4).double(), torch.zeros(1).double(), hand_eye_is_free=False)
    root = drawn(3, 4, 4) * torch.tensor([1e-3, 3e-3, 1e-2])[:, None, None]
    covariance = root @ root.mT
    precision = noise**2 * plane_precision(normal, covariance)
    held = MomentObjective(within_prior(moments, at, precision))
    # By hand: y + x c0, with the covariance of the noise and of each image's plane.
    moves = torch.cat([distance[..., None] * ray, one], dim=2) @ plane_moves(normal).mT
    # A hundredth of a millimetre is added to what is not known of a plane.
    of_plane = (
        plane_moves(normal) @ covariance @ plane_moves(normal).mT + 1e-10 * torch.eye(3).double()
    )
    inverse = torch.linalg.inv(noise**2 * torch.eye(5).double() + moves @ of_plane @ moves.mT)
    x, y = -gain[:, :, None], (gain * distance + 1.2)[:, :, None]
    information = (x.mT @ inverse @ x).sum()
    expected = -float((x.mT @ inverse @ y).sum() / information)
    found = minimise(held, at).parameters
    assert float(found.coefficients[0]) == pytest.approx(expected, abs=1e-7)
    curvature = float(held.normal_equations(found).hessian) / noise**2
    assert curvature == pytest.approx(float(information), rel=1e-6)
    plain = minimise(MomentObjective(moments), at).parameters
    assert abs(float(plain.coefficients[0]) - expected) > 1e-5


def test_unknown_planes_leave_what_is_within_views_and_exact_ones_all(tmp_path: Path) -> None:
    dataset = simulated_wall(tmp_path / "recording")
    recording, every = dataset.first, range(dataset.num_frames)
    model = without_correction(covered_domain(dataset, every), recorded_hand_eye(dataset))

    def judged(size: float | None) -> dict[str, float]:
        known = None if size is None else np.tile(size * np.eye(4), (dataset.num_frames, 1, 1))
        frames = replace(recording.frames, plane_covariance=known)
        changed = Dataset((replace(recording, frames=frames),))
        return views_mm(frame_errors(changed, {"before": model}, variance=1e-2)["before"])

    unknown, exact, as_given = judged(1e6), judged(0.0), judged(None)
    assert unknown["within_prior"] == pytest.approx(unknown["within_views"], rel=1e-3)
    assert exact["within_prior"] == pytest.approx(exact["rms_z"], rel=1e-2)
    assert as_given["within_prior"] == as_given["rms_z"] > as_given["within_views"] > 0
    whole = as_given["between_views"] ** 2 + as_given["within_views"] ** 2
    assert whole == pytest.approx(as_given["rms_z"] ** 2)
