"""Flying pixels are found where surfaces are mixed, and hardly anywhere else."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from correction.export.states import calibration, write
from kinds_of_terms import DOMAIN
from torch import Generator, Tensor

from tofcorr.correction.corrector import DepthCorrector
from tofcorr.correction.export.parity import probe_frames
from tofcorr.correction.state import CalibrationState, SceneLight
from tofcorr.errors import ConfigError
from tofcorr.geometry.camera import CameraIntrinsics
from tofcorr.scene_light.flying import FlyingPixels, FlyingPixelsState, squared_spreads

CAMERA = CameraIntrinsics(
    width=64,
    height=48,
    matrix=((58.0, 0, 31.5), (0, 58.0, 23.5), (0, 0, 1)),
    distortion=(-0.1, 0, 0, 0),
)
NOISE_M = 3e-3
STATE = FlyingPixelsState(point_spread_px=0.45, false_alarm=0.01, noise=(NOISE_M**2, 0.0, 0.0))


def finder(camera: CameraIntrinsics = CAMERA, **changed: Any) -> FlyingPixels:
    return FlyingPixels(camera, "radial", STATE.model_copy(update=changed)).double()


def plane(found: FlyingPixels, normal: tuple[float, float, float], offset: float) -> Tensor:
    """Distances along the rays to n . x = offset."""
    from tofcorr.geometry.rays import ray_directions

    return offset / (ray_directions(CAMERA) @ torch.tensor(normal, dtype=torch.float64))


@pytest.mark.parametrize("normal", [(0, 0, 1), (0.6, 0.0, 0.8), (0.4, 0.5, 0.77)])
def test_of_noise_on_a_plane_no_more_is_flagged_than_was_chosen(
    normal: tuple[float, float, float], generator: Generator
) -> None:
    found = finder()
    distance = plane(found, normal, 1.2).repeat(20, 1, 1)
    distance += NOISE_M * torch.randn(distance.shape, generator=generator)
    distance[:, ::7, ::5] = torch.nan  # And where returns are missing.
    flying, _ = found.found(distance, torch.ones_like(distance))
    assert flying[distance.isfinite()].double().mean() <= STATE.false_alarm
    assert not flying[distance.isnan()].any()


def test_with_one_plane_beside_it_a_pixel_is_flagged_as_often_as_was_chosen(
    generator: Generator,
) -> None:
    # The last pixel of the middle row has one square beside it, whose middle is two pixels away.
    # The plane is so steep that the neighbours of a pixel are unlike it.
    camera = replace(CAMERA, width=5, height=3, distortion=())
    found, count = finder(camera, noise=(1e-8, 0.0, 0.0)), 40_000
    inverse = 1 + 0.02 * torch.arange(5.0).double().repeat(count, 3, 1)
    distance = 1 / (inverse * found.z_of_depth)
    distance += 1e-4 * torch.randn(distance.shape, generator=generator)
    flying, _ = found.found(distance, torch.ones_like(distance))
    # A hundredth of the squares does not fit itself, and there is nothing beside the pixel then.
    expected = 0.01 + 0.01 * 0.99
    assert float(flying[:, 1, 4].double().mean()) == pytest.approx(
        expected, abs=4 * (expected / count) ** 0.5
    )


def mixed(share: Tensor, near: float, far: float, bright: float) -> tuple[Tensor, Tensor]:
    """Distance and amplitude of pixels of which a share sees the nearer wall, so much brighter."""
    light = bright * share / (bright * share + 1 - share)
    return far + (near - far) * light, bright * share + 1 - share


@pytest.mark.parametrize("bright", [0.3, 1.0, 3.0])
def test_a_mixture_of_two_walls_is_found_and_the_certain_one_given(bright: float) -> None:
    found, share = finder(), torch.zeros(48, 64).double()
    share[:, :32] = 1.0
    share[:, 32] = torch.tensor([0.1, 0.5, 0.9]).repeat(16)
    distance, amplitude = mixed(share, 1.0, 1.6, bright)
    depth, valid = found(distance, amplitude, torch.ones_like(share, dtype=torch.bool))
    inner = slice(6, -6)
    assert not valid[inner, 32].any()
    assert valid[:, :32].all()
    assert valid[:, 33:].all()
    assert torch.equal(depth[:, :32], distance[:, :32])
    truth = torch.tensor([1.6, torch.nan, 1.0]).repeat(16)
    expected = torch.where(truth.isfinite(), truth, distance[:, 32])
    # The walls are spheres around the camera, continued as planes: 3 mm.
    torch.testing.assert_close(depth[inner, 32], expected[inner], rtol=0, atol=3e-3)


def test_pixels_of_a_slat_two_pixels_wide_are_not_flying(generator: Generator) -> None:
    distance = torch.full((48, 64), 1.6).double()
    distance[:, 20:22] = 1.0
    distance += NOISE_M * torch.randn(distance.shape, generator=generator)
    flying, _ = finder(false_alarm=1e-4).found(distance, torch.ones_like(distance))
    assert not flying.any()


@pytest.mark.parametrize("depth_kind", ["radial", "z"])
@pytest.mark.parametrize("name", ["torchscript", "c", "pt2"])
def test_an_exported_corrector_finds_what_the_float64_model_finds(
    name: str, depth_kind: str, tmp_path: Path
) -> None:
    # Every export is compared with the model before it is kept, on an edge besides.
    domain = replace(DOMAIN, width=64, height=48)
    scene = {"flying_pixels": STATE.to_mapping()}
    state = calibration(depth_kind=depth_kind, camera=CAMERA, domain=domain, scene=scene)
    depth, amplitude = (one[-1] for one in probe_frames(state))
    corrected, valid = state.corrected(depth, amplitude)
    edge = state.model_copy(update={"scene": SceneLight()}).corrected(depth, amplitude)[1] & ~valid
    assert edge[:, 32].all()
    assert edge.sum() == 48
    # Of the rows that a tenth, half and nine tenths of the farther wall share, two are certain.
    near, far = ((corrected[:, 32] - corrected[:, k]).abs() < 0.01 for k in (31, 33))
    kinds = torch.stack([near, far]).view(2, -1, 3)[:, 2:-2].all(dim=1)
    assert kinds.tolist() == [[True, False, False], [False, False, True]]
    if name == "pt2":  # What it compiles; compiling it takes long.
        from tofcorr.correction.export.pt2 import CompilableCorrector

        found = CompilableCorrector(DepthCorrector.from_state(state))(depth, amplitude)
        expected = DepthCorrector.from_state(state)(depth, amplitude)
        torch.testing.assert_close(found[0], expected[0], rtol=0, atol=1e-6)
        assert torch.equal(found[1].bool(), expected[1])
        return
    write(name, state, tmp_path / f"corrector.{'ts' if name == 'torchscript' else 'c'}")


def test_a_table_refuses_flying_pixels_in_words(tmp_path: Path) -> None:
    state = calibration(scene={"flying_pixels": STATE.to_mapping()})
    with pytest.raises(
        ConfigError, match=r"lut export holds no flying_pixels: export torchscript, pt2, onnx, c\."
    ):
        write("lut", state, tmp_path / "table.npz")


def test_a_calibration_of_before_has_none() -> None:
    values = calibration().model_dump()
    del values["scene"]
    assert CalibrationState.model_validate(values).flying_pixels() is None


def test_scripted_it_finds_the_same(generator: Generator) -> None:
    found = finder()
    share = torch.rand(3, 48, 64, generator=generator).double().round(decimals=1)
    distance, amplitude = mixed(share, 1.0, 1.6, 2.0)
    every = torch.ones_like(share, dtype=torch.bool)
    expected = found(distance, amplitude, every)
    scripted = torch.jit.script(found)(distance, amplitude, every)
    torch.testing.assert_close(scripted, expected, rtol=0, atol=0)


@pytest.mark.parametrize("blur", [0.3, 0.6, 1.0])
def test_the_point_spread_is_measured_at_edges_of_any_direction(blur: float) -> None:
    # The area of a pixel has a variance of 1/12 along every direction.
    width = (blur**2 + 1 / 12) ** 0.5
    rows, columns = torch.meshgrid(torch.arange(60.0), torch.arange(80.0), indexing="ij")
    images = []
    for angle in torch.linspace(0, 3.1, 12):
        across = (columns - 40) * angle.cos() + (rows - 30) * angle.sin() + 0.3
        fine = across[..., None] + (torch.arange(32) + 0.5) / 32 - 0.5
        images.append(100 + 400 * torch.special.ndtr(fine / blur).mean(-1))
    amplitude = torch.stack(images)
    found = squared_spreads(amplitude)
    assert len(found) > 500
    # Of the tails of a wide spread, the slopes beside the edge take a part.
    assert float(found.median()) ** 0.5 == pytest.approx(width, rel=0.1)
