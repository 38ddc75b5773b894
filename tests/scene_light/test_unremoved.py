"""The uncertainty of a corrected pixel in the light of a scene, and the fit without that light."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from correction.export.states import calibration
from kinds_of_terms import DOMAIN
from scene_light.test_bounces import (
    CAMERA,
    CORNER,
    FREQUENCY,
    ROOM,
    STATE,
    bounces,
    room,
    state_with_bounces,
    walls,
)
from torch import Generator, Tensor

import tofcorr
from tofcorr.correction.corrector import DepthCorrector
from tofcorr.correction.state import SceneLight
from tofcorr.data.table import FrameRow
from tofcorr.data.writing import write_recording
from tofcorr.geometry import se3
from tofcorr.geometry.rays import ray_directions
from tofcorr.options import resolve_options
from tofcorr.pixels.dataset import Dataset
from tofcorr.scene_light.bounces import SecondBounces
from tofcorr.scene_light.flying import FlyingPixelsState
from tofcorr.scene_light.unremoved import UnremovedBounces
from tofcorr.training.calibration import TrainingOptions

ARRAYS = "depth", "amplitude", "mask"


def unremoved(**changed: object) -> UnremovedBounces:
    return UnremovedBounces(bounces(**changed), STATE.model_copy(update=changed)).double()


def stated(own: UnremovedBounces, image: Tensor, light: Tensor) -> Tensor:
    return own(image, light, light > 0)


WALL = ((0.0, 0.0, -1.0), 1.5)
CONE = {"light_half_angle_deg": 50.0}


def test_of_a_lone_wall_nothing_is_uncertain() -> None:
    left = stated(unremoved(gain_interval=(0.001, 0.003)), *walls(((0.2, 0.1, -0.9746794), 1.5)))
    torch.testing.assert_close(left, torch.zeros_like(left), rtol=0, atol=1e-7)


def test_the_gains_interval_counts_as_a_share_of_what_is_removed() -> None:
    measured, light = bounces().added(*CORNER)
    low, high = 0.8 * STATE.gain, 1.2 * STATE.gain
    certain, uncertain = (
        stated(unremoved(gain_interval=x), measured, light) for x in (None, (low, high))
    )
    removed = measured - bounces().removed(measured, light)
    share = (uncertain.square() - certain.square()).sqrt() / removed
    torch.testing.assert_close(share, torch.full_like(share, 0.4 / 3.92), rtol=1e-3, atol=0)


def beside(*panels: tuple[tuple[float, float, float], float]) -> tuple[Tensor, Tensor]:
    """A wall as seen beside panels that are outside of the image."""
    wide = replace(
        CAMERA, width=64, height=48, matrix=((26.0, 0, 31.5), (0, 26.0, 23.5), (0, 0, 1.0))
    )
    around = SecondBounces(wide, STATE.model_copy(update=CONE)).double()
    image, light = around.added(*walls(WALL, *panels, camera=wide))
    return image[12:36, 16:48], light[12:36, 16:48]


@pytest.mark.parametrize("normal", [(0.0, -1.0, 0.0), (0.0, 1.0, 0.0), (-1.0, 0.0, 0.0)])
def test_a_panel_outside_of_the_image_is_covered(normal: tuple[float, float, float]) -> None:
    image, light = beside((normal, 0.7 if normal[1] else 1.0))
    errors = bounces(**CONE).removed(image, light) - walls(WALL)[0]
    assert errors.mean() > 0.01
    found = stated(unremoved(**CONE), image, light)
    assert 0.7 < float((errors.square().mean() / found.square().mean()).sqrt()) < 1.5


def test_the_more_light_from_outside_the_more_is_stated(generator: Generator) -> None:
    noise = 3e-3 * torch.randn(24, 32, generator=generator).double()
    scenes = (), (((0.0, -1.0, 0.0), 1.0),), (((0.0, -1.0, 0.0), 0.75),)
    lone, far, near = (
        float(stated(unremoved(**CONE), image + noise, light).mean())
        for image, light in (beside(*panels) for panels in scenes)
    )
    assert 2 * lone < far < near


def test_a_bend_that_the_calibration_explains_is_no_light(generator: Generator) -> None:
    own = unremoved(**CONE)
    measured, strength = own.bounces.cells(*walls(WALL))
    known, nothing = own.bounces.planes(measured), torch.zeros(2, 1, 24 * 32).double()
    *_, bend, _, _, _ = own.columns_beyond(known, strength, nothing, known[0][:, 0])
    # Of a floor just below the image.
    noisy = measured + 0.5 * bend + 1e-3 * torch.randn(24 * 32, generator=generator).double()

    def light_of(explained: Tensor) -> float:
        found, _ = own.outside(noisy, measured, known, strength, nothing, explained[None])
        return float((found.mean() / bend.square().mean()).sqrt())

    assert light_of(0.0 * bend) == pytest.approx(0.5, rel=0.2)
    assert light_of(bend) < 0.05


def test_only_where_light_reaches_surfaces_outside_of_the_image_add_some() -> None:
    def most(degrees: float) -> float:
        own = unremoved(light_half_angle_deg=degrees)
        radial, light = own.bounces.cells(*walls(WALL))
        nothing = torch.zeros(2, 1, radial.shape[0]).double()
        known = own.bounces.planes(radial)
        return float(own.columns_beyond(known, light, nothing, known[0][:, 0]).amax())

    assert most(20.0) == 0
    assert 0 < most(40.0) < most(50.0)


def test_backs_of_patches_count_where_light_gets_behind_them() -> None:
    def backs(image: Tensor, light: Tensor) -> Tensor:
        own = unremoved()
        planes, fits, _ = own.bounces.planes(own.bounces.cells(image, light)[0])
        return own.by_the_backs(planes, fits, light.reshape(-1)).reshape(24, 32)

    assert float(backs(*CORNER).abs().max()) < 1e-9
    rays = ray_directions(CAMERA)
    across = (rays[..., 0] / rays[..., 2]).abs()
    board = torch.where(across < 0.2, 1.2, 1.6) / rays[..., 2]
    light = rays[..., 2] / board.square() * CORNER[1].mean() * 2
    found = backs(board, light)
    beside, far = (across > 0.25) & (across < 0.35), across > 0.5
    assert found[beside].mean() > 2 * found[far].mean() > 0
    assert found[across < 0.15].abs().max() < 1e-9


def test_the_corrector_adds_up_what_is_known_scripted_as_well() -> None:
    size = len(state_with_bounces().coefficients)
    known = {"noise": (1e-6, 1e-4, 0.0), "covariance": 1e-6 * torch.eye(size).double()}
    state = state_with_bounces().model_copy(update=known)
    depth, light = (image.float() for image in CORNER)
    corrector = DepthCorrector.from_state(state)
    total = corrector.uncertainty(depth, light)
    plain = state.model_copy(update={"scene": SceneLight()})
    without = DepthCorrector.from_state(plain)
    noise, calibrated = without.sigma(depth, light)
    torch.testing.assert_close(
        without.uncertainty(depth, light).square(), noise.square() + calibrated.square()
    )
    scale = corrector.radial_of_z
    own = UnremovedBounces(bounces().float(), STATE, without.known_sigma)
    plain, valid = without(depth, light)
    left = own(plain * scale, light, valid) / scale
    expected = noise.square() + calibrated.square() + left.square()
    torch.testing.assert_close(total.square(), expected, rtol=1e-3, atol=1e-9)
    both = torch.jit.script(corrector).uncertainty(depth.repeat(2, 1, 1), light.repeat(2, 1, 1))
    torch.testing.assert_close(both, total.repeat(2, 1, 1))


def test_beside_flying_pixels_what_is_not_found_counts() -> None:
    flying = FlyingPixelsState(point_spread_px=0.3, noise=(1e-6, 0.0, 0.0))
    known = {"noise": (1e-6, 0.0, 0.0), "covariance": torch.zeros(1, 1).double()}
    size = {"camera": CAMERA, "domain": replace(DOMAIN, width=32, height=24)}
    state = calibration(None, [], scene=SceneLight(flying_pixels=flying), **size, **known)
    depth = torch.full((24, 32), 1.0)
    depth[:, 16:], depth[10, 15] = 2.0, 1.5
    light, corrector = torch.full_like(depth, 100.0), DepthCorrector.from_state(state)
    corrected, valid = corrector(depth, light)
    wider = corrector.uncertainty(depth, light) / corrector.sigma(corrected, light)[0]
    assert not valid[10, 15]
    assert corrector.flying is not None
    expected = math.sqrt(1 + corrector.flying.threshold**2 / 3)
    assert float(wider[9, 14]) == pytest.approx(expected, rel=1e-4)
    assert float(wider[9, 12]) == pytest.approx(1.0, rel=1e-4)


def recording_of_walls(folder: Path, generator: Generator, *, moves: bool = False) -> Path:
    """A recording of walls with a second one beside each, which sends them light."""
    images, rows = [], []
    for k in range(12):
        angle = math.radians(15 + k)
        wall = ((math.sin(angle), 0.0, -math.cos(angle)), 1.1 + 0.05 * k)
        direct = walls(wall, ((-math.cos(angle), 0.0, -math.sin(angle)), 1.0))
        lit, light = bounces().added(*direct)
        noise = 1e-3 * torch.randn(lit.shape, generator=generator).double()
        mask = (direct[0] - walls(wall)[0]).abs() < 1e-9
        images.append((lit + 0.01 * lit + noise, light, mask))
        twist = torch.randn(6, generator=generator).double() * (0.5 if moves else 0.0)
        pose = se3.exp(twist)
        normal = pose[:3, :3] @ torch.tensor(wall[0]).double()
        rows.append(
            FrameRow(
                timestamp=float(k),
                world_from_tool=pose.numpy(),
                normal_world=normal.numpy(),
                offset=wall[1] - float(normal @ pose[:3, 3]),
                target="white",
                pose_id=k,
            )
        )
    depth, light, mask = (torch.stack(x).numpy() for x in zip(*images, strict=True))
    write_recording(
        folder,
        camera=CAMERA,
        depth_kind="radial",
        rows=rows,
        modulation_frequency=FREQUENCY,
        tool_from_camera=np.eye(4),
        depth=depth.astype(np.float32),
        amplitude=light.astype(np.float32),
        mask=mask.astype(np.uint8),
    )
    return folder


CONFIG = {
    "name": "line",
    "model": {"terms": [{"kind": "distance_polynomial", "degree": 1}]},
    "runtime": {"second_bounces": {"gain": STATE.gain, "patch_px": 2}},
    "split": {"test_fraction": 0.0},
    "figures": False,
    "advice": 0,
}


def test_the_base_error_is_fitted_without_second_bounces(
    tmp_path: Path, generator: Generator
) -> None:
    recording = recording_of_walls(tmp_path / "walls", generator)
    lone, light = (image.float() for image in walls(((0.0, 0.0, -1.0), 1.4)))
    run = tofcorr.train(recording, CONFIG, force=True)
    found, _ = run.corrector()(1.01 * lone, light)
    # Fitted with second bounces in the frames, the base error is off by centimetres.
    assert float((found - lone).abs().mean()) < 1.5e-3


def test_a_live_calibration_is_fitted_without_second_bounces_too(
    tmp_path: Path, generator: Generator
) -> None:
    folder = recording_of_walls(tmp_path / "walls", generator, moves=True)
    recording = tofcorr.Recording.open(folder)
    options = resolve_options(TrainingOptions, CONFIG, ["runtime.second_bounces.learned={}"])
    live = tofcorr.LiveCalibration(recording, options, folder=tmp_path / "live")
    for k in range(recording.num_frames):
        depth, light, mask = (recording.read(n, np.array([k])) for n in ARRAYS)
        assert depth is not None
        assert light is not None
        assert mask is not None
        row = recording.frames.row(k)
        live.add_frame(row, depth[0], light[0], mask[0], plane_is_known=True)
    trained = tofcorr.train(recording, CONFIG, force=True)
    resumed = tofcorr.LiveCalibration.resume(tmp_path / "live")
    for one in (live, resumed):
        found = one.state()
        torch.testing.assert_close(found.coefficients, trained._state.coefficients)
        assert found.scene == trained._state.scene
        assert found.remainder is None  # A state is asked for often: its network comes last.


def test_the_room_of_a_world_is_there_when_frames_are_freed_of_its_light(
    tmp_path: Path, generator: Generator
) -> None:
    data = Dataset((tofcorr.Recording.open(recording_of_walls(tmp_path / "walls", generator)),))
    poses = torch.eye(4).double().repeat(data.num_frames, 1, 1)
    poses[:, 0, 3] = torch.linspace(0.0, 0.1, data.num_frames)
    data = data.with_columns(world_from_tool=poses.numpy())
    scene = {"second_bounces": STATE.to_mapping() | {"room": ROOM, "room_in_image": False}}
    changed = {"scene": SceneLight.model_validate(scene), "tool_from_camera": torch.eye(4).double()}
    state = state_with_bounces().model_copy(update=changed)
    direct = next(data.without_second_bounces(state).batches([0, 11])).radial_distance
    own = room(room_in_image=False, continued=True)
    plain = DepthCorrector.from_state(state.model_copy(update={"scene": SceneLight()}))
    batch = next(data.batches([0, 11]))
    assert batch.amplitude is not None
    for k, frame in enumerate((0, 11)):
        radial, light = batch.radial_distance[k].float(), batch.amplitude[k].float()
        corrected = plain(radial / plain.radial_of_z, light)[0] * plain.radial_of_z
        own.room.set_pose(poses[frame])
        off = corrected - own.float()(corrected, light)
        torch.testing.assert_close(radial - direct[k].float(), off, rtol=0.1, atol=1e-3)
