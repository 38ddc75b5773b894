"""The linear form of an image is its derivative; the functions of the form keep to their scale."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from simulated_walls import fitted, simulated_wall

from tofcorr.correction.model import HandEye
from tofcorr.error_terms.base import Domain, Interval
from tofcorr.error_terms.model import Pixels
from tofcorr.fit.linear_image import CLASSES, LinearPixels, form_classes, form_functions, linearised
from tofcorr.fit.reference import estimate_reference
from tofcorr.geometry import se3
from tofcorr.geometry.rays import plane_in_frame
from tofcorr.pixels.sample import pixels_of_image

WITHOUT = Domain(height=25, width=32, radial_distance=Interval(0.5, 2.0))
LIGHT = {"amplitude": Interval(50.0, 5000.0), "normalised_amplitude": Interval(100.0, 2000.0)}
DOMAIN = replace(WITHOUT, **LIGHT)


def pixels(count: int) -> Pixels:
    random = torch.rand(4, count, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return Pixels(
        0.5 + 1.5 * random[0],
        50.0 * 100.0 ** random[1],
        24 * random[2],
        31 * random[3],
        torch.zeros(count, 0, dtype=torch.float64),
    )


def test_every_function_has_a_class_and_about_unit_size() -> None:
    values = torch.cat(form_functions(DOMAIN, pixels(500), torch.full((500,), -0.9).double()))
    classes = form_classes(DOMAIN)
    assert len(values) == len(classes)
    assert set(classes.tolist()) == set(range(CLASSES))
    assert float(values.abs().max()) <= 1.0 + 1e-9


def test_without_amplitudes_no_function_reads_them() -> None:
    some = pixels(50)
    gain = torch.full((50,), -0.9).double()
    unknown = some._replace(amplitude=torch.full((50,), torch.nan).double())
    seen, unseen = (torch.cat(form_functions(WITHOUT, one, gain)) for one in (some, unknown))
    torch.testing.assert_close(seen, unseen)


def test_the_columns_are_derivatives_of_the_residual(tmp_path: Path) -> None:
    dataset = simulated_wall(tmp_path / "wall", 3, (("white", 8), ("checkerboard", 8)))
    fit = fitted(dataset)
    hand_eye = fit.solution.parameters.tool_from_camera
    batch = next(dataset.batches([0]))
    used = batch.valid[0].flatten().nonzero()[:, 0]
    seen, rays = pixels_of_image(batch, 0, used), dataset.ray_directions().flatten(0, 1)[used]

    def linear(twist: torch.Tensor) -> LinearPixels:
        moved = HandEye(hand_eye @ se3.exp(twist), fixed=True)().detach()
        plane = plane_in_frame(batch.normal_tool[0], batch.offset_tool[0], moved)
        return linearised(fit.model.error, seen, rays, plane, twist=True, domain=fit.domain)

    at = linear(torch.zeros(6).double())
    step = 1e-5 * torch.eye(6, dtype=torch.float64)
    numeric = [(linear(own).residual - linear(-own).residual) / 2e-5 for own in step]
    numeric = torch.stack(numeric, dim=1)
    # The columns stand where the wall is, the residual where the noise puts the pixels.
    off = float((at.residual / at.gain).abs().max())
    torch.testing.assert_close(at.unknowns[:, :6], numeric, rtol=0, atol=1.5 * off)
    torch.testing.assert_close(at.unknowns[:, 6], -at.gain)


def test_the_poses_errors_are_measured(tmp_path: Path) -> None:
    robot = {"repeatability_mm": 1.5, "repeatability_mrad": 0.2}
    dataset = simulated_wall(tmp_path / "wall", 5, robot=robot)
    found = estimate_reference(dataset, np.arange(dataset.num_frames), fitted(dataset), None)
    assert found is not None
    assert found.poses == 30
    # A standard deviation of 30 poses is known to 13 %; three of these.
    assert 0.9e-3 < float(found.random_variance[2].sqrt()) < 2.1e-3
    values = torch.linalg.eigvalsh(found.covariance)
    assert float(values.min()) > -1e-12 * float(values.max())
    # These images depart less from each other than their noise lets expect: they tell more.
    assert found.scatter < 1
    assert found.covariance_within is not None
    assert float(found.covariance_within.trace()) < float(found.covariance.trace())
