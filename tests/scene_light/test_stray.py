"""Stray light is taken back: against the simulator's own, which shares no code with it."""

import pytest
import torch

from tofcorr.geometry.camera import CameraIntrinsics
from tofcorr.geometry.rays import phase_from_radial_distance, unambiguous_range
from tofcorr.scene_light.stray import StrayLight, StrayLightState
from tofcorr.simulation.effects.stray_light import StrayLightShape, _scattered

F = 20e6
# Three Gaussians, a veil, and ghosts of five sizes.
COEFFICIENTS = [0.02, 0.03, 0.04, 0.03, 0.0, 0.01, 0.0, 0.0, 0.02]
CAMERA = CameraIntrinsics(
    width=160, height=120, matrix=((150.0, 0.0, 81.0), (0.0, 150.0, 57.5), (0.0, 0.0, 1.0))
)


def scene() -> tuple[torch.Tensor, torch.Tensor]:
    """A bright board before a dark wall, and a corner without a return."""
    radial = torch.full((120, 160), 1.7, dtype=torch.float64)
    amplitude = torch.full((120, 160), 150.0, dtype=torch.float64)
    radial[30:80, 20:70], amplitude[30:80, 20:70] = 0.8, 3000.0
    return radial, amplitude


def scattered(radial: torch.Tensor, amplitude: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Distances and amplitudes with the simulator's stray light."""
    own = torch.polar(amplitude, phase_from_radial_distance(radial, F))[None]
    ways = _scattered(own, CAMERA, StrayLightShape())
    found = own + ways @ torch.tensor(COEFFICIENTS, dtype=torch.complex128)
    turned = (found / own).angle()[0] * unambiguous_range(F) / (2 * torch.pi)
    return radial + turned, found.abs()[0]


@pytest.fixture(scope="module")
def state() -> StrayLightState:
    shape = StrayLightShape()
    return StrayLightState(
        modulation_frequency=F,
        sigma_of_width=shape.sigma_of_width,
        shares=tuple(COEFFICIENTS[:3]),
        veil=COEFFICIENTS[3],
        ghost_sizes=shape.ghost_sizes,
        ghost_shares=tuple(COEFFICIENTS[4:]),
    )


def test_what_the_simulator_scatters_is_taken_back(state: StrayLightState) -> None:
    radial, amplitude = scene()
    measured, light = scattered(radial, amplitude)
    corrected, strength = StrayLight(CAMERA, state).double()(measured, light)
    before, after = ((one - radial).square().mean().sqrt() for one in (measured, corrected))
    assert before > 0.02
    assert after < 0.03 * before
    torch.testing.assert_close(strength, amplitude, rtol=0.02, atol=1.0)


def test_a_script_does_the_same_and_pixels_without_a_return_stay_and_send_no_light(
    state: StrayLightState,
) -> None:
    measured, light = (image.float().repeat(2, 1, 1) for image in scattered(*scene()))
    measured[0, :40], light[1, 50] = torch.nan, torch.nan
    stray = StrayLight(CAMERA, state)
    found = stray(measured, light)
    torch.testing.assert_close(torch.jit.script(stray)(measured, light), found, equal_nan=True)
    assert found[0][0, :40].isnan().all()
    torch.testing.assert_close(found[0][1, 50], measured[1, 50])
    dark = torch.where(measured.isnan(), 0.0, light)
    torch.testing.assert_close(stray(measured.nan_to_num(1.0), dark)[0][0, 40:], found[0][0, 40:])


def test_more_stray_light_than_light_is_refused() -> None:
    with pytest.raises(ValueError, match="below 1"):
        StrayLightState(modulation_frequency=F, shares=(0.7,), sigma_of_width=(0.1,), veil=0.4)


def test_a_camera_without_stray_light_measures_what_it_did() -> None:
    radial, amplitude = scene()
    none = StrayLight(CAMERA, StrayLightState(modulation_frequency=F)).double()
    torch.testing.assert_close(none(radial, amplitude), (radial, amplitude))
