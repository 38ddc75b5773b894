"""Uncertainty at runtime, against the covariance it is made from."""

from typing import Any

import pytest
import torch
from correction.export.states import calibration
from synthetic_scene import EB
from torch import Generator

from tofcorr.correction.corrector import DepthCorrector
from tofcorr.correction.export.torchscript import scripted
from tofcorr.geometry.rays import ray_directions

SPLINES = {"kind": "distance_spline", "segments": 5}, {"kind": "tensor_spline"}
MODELS: dict[str, list[dict[str, Any]]] = {
    "EB": EB["terms"],
    "splines": [*SPLINES, {"kind": "incident_light"}],
    "periodic": [{"kind": "periodic"}, {"kind": "lookup_table", "segments": 6}],
}


def frames(generator: Generator) -> tuple[torch.Tensor, torch.Tensor]:
    depth = 0.6 + 2.2 * torch.rand(3, 5, 7, generator=generator)
    return depth, 20.0 + 800.0 * torch.rand(3, 5, 7, generator=generator)


@pytest.mark.parametrize("name", MODELS)
def test_calibration_sigma_is_the_spread_of_models_drawn_from_the_covariance(
    name: str, generator: Generator
) -> None:
    size = len(calibration(terms=MODELS[name]).coefficients)
    root = 1e-3 * torch.randn(size, size, generator=generator, dtype=torch.float64)
    covariance = root @ root.T
    state = calibration(None, MODELS[name], "radial", covariance=covariance)
    depth, amplitude = frames(generator)
    runtime = scripted(DepthCorrector.from_state(state))
    _, found = runtime.sigma(depth, amplitude)
    # The error is linear: columns of the root are the model's errors with those coefficients.
    model = state.model().error
    square = torch.zeros(3, 5, 7, dtype=torch.float64)
    for column in root.unbind(1):
        model.set_coefficient_vector(column)
        square += model(depth.double(), amplitude.double()).detach().square()
    torch.testing.assert_close(found.double(), square.sqrt(), rtol=1e-4, atol=1e-7)


def test_noise_sigma_follows_the_amplitude_and_the_kind_of_depth(generator: Generator) -> None:
    depth, amplitude = frames(generator)
    depth[0, 0, 0], depth[0, 0, 1] = torch.nan, -1.0
    noise = (1e-6, 1e-4, 2e-3)
    state = calibration(None, [], "radial", noise=noise)
    radial, _ = DepthCorrector.from_state(state).sigma(depth, amplitude)
    expected = (1e-6 + 1e-4 / amplitude + 2e-3 / amplitude.square()).sqrt()
    expected[0, 0, :2] = torch.nan
    torch.testing.assert_close(radial, expected, equal_nan=True)
    z_state = calibration(None, [], "z", noise=noise)
    in_z, _ = DepthCorrector.from_state(z_state).sigma(depth, amplitude)
    cosine = ray_directions(z_state.camera)[..., 2].float()
    torch.testing.assert_close(in_z, expected * cosine, equal_nan=True)


def test_what_the_calibration_does_not_tell_is_nan(generator: Generator) -> None:
    depth, amplitude = frames(generator)
    state = calibration(terms=MODELS["EB"])
    for unknown in DepthCorrector.from_state(state).sigma(depth, amplitude):
        assert unknown.isnan().all()
