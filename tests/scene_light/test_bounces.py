"""Second bounces of light are as an integral over the scene has them, and are removed again."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from correction.export.states import calibration, write
from kinds_of_terms import DOMAIN
from torch import Generator, Tensor

from tofcorr.correction.corrector import DepthCorrector
from tofcorr.correction.state import CalibrationState, SceneLight
from tofcorr.errors import CalibrationDataError, ConfigError
from tofcorr.geometry.camera import CameraIntrinsics
from tofcorr.geometry.rays import SPEED_OF_LIGHT, ray_directions
from tofcorr.scene_light.bounces import SecondBounces, SecondBouncesState
from tofcorr.scene_light.gain import fit_gain
from tofcorr.sensor.model import SensorModel
from tofcorr.sensor.sensor_file import SensorFile
from tofcorr.training.scene import patch_within, recorded_room

FREQUENCY, GAIN = 20e6, 1 / 500
CAMERA = CameraIntrinsics(
    width=32, height=24, matrix=((26.0, 0, 15.5), (0, 26.0, 11.5), (0, 0, 1.0))
)
STATE = SecondBouncesState(frequencies_hz=(FREQUENCY,), gain=GAIN, patch_px=2)
LEFT, RIGHT = (0.7071068, 0.0, -0.7071068), (-0.7071068, 0.0, -0.7071068)
"""Normals of the sides of a corner, upright, that opens towards the camera."""


def bounces(**changed: object) -> SecondBounces:
    return SecondBounces(CAMERA, STATE.model_copy(update=changed)).double()


def walls(
    *planes: tuple[tuple[float, float, float], float], camera: CameraIntrinsics = CAMERA
) -> tuple[Tensor, Tensor]:
    """The nearest of planes n . x + d = 0 along each ray, lit, half white."""
    rays, near, light = ray_directions(camera), torch.tensor(math.inf), torch.tensor(0.0)
    for normal, offset in planes:
        cosine = -(rays @ torch.tensor(normal, dtype=torch.float64))
        distance = torch.where(cosine > 0, offset / cosine, math.inf)
        light = torch.where(distance < near, cosine / distance**2 / GAIN, light)
        near = torch.minimum(near, distance)
    return near, 0.5 * light / math.pi


CORNER = walls((LEFT, 1.3), (RIGHT, 1.1))


def integral(pixel: tuple[int, int]) -> complex:
    """One bounce at a pixel of the corner over its direct light: a sum over fine patches."""
    step = 8
    rows, columns = np.mgrid[: 24 * step, : 32 * step] / step + (0.5 / step - 0.5)

    def seen(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        slope = np.stack([(x - 15.5) / 26, (y - 11.5) / 26, np.ones_like(x)], axis=-1)
        at = [
            slope * (offset / -(slope @ n))[..., None] for n, offset in ((LEFT, 1.3), (RIGHT, 1.1))
        ]
        left = at[0][..., 2] < at[1][..., 2]
        return (
            slope,
            np.where(left[..., None], at[0], at[1]),
            np.where(left[..., None], LEFT, RIGHT),
        )

    slope, at, normal = seen(columns, rows)
    _, here, up = (one[0] for one in seen(np.array([float(pixel[1])]), np.array([float(pixel[0])])))
    away, own = np.linalg.norm(at, axis=-1), np.linalg.norm(here)
    # A patch of the plane z = 1 has an area of z^2 n_z / (n . ray) on a plane.
    area = at[..., 2] ** 2 / -(slope * normal).sum(-1) / (26 * step) ** 2
    light = 0.5 / math.pi * -(at * normal).sum(-1) / away**3
    way = here - at
    length = np.linalg.norm(way, axis=-1)
    facing = (way * normal).sum(-1).clip(0) * (-way @ up).clip(0) / length**4
    turn = 2j * np.pi * FREQUENCY / SPEED_OF_LIGHT * (away + length - own)
    return complex((area * light * facing * np.exp(turn)).sum() * own**3 / -(here @ up))


@pytest.mark.parametrize("pixel", [(12, 3), (5, 10), (18, 26)])
def test_one_bounce_in_a_corner_is_the_integral_over_its_sides(pixel: tuple[int, int]) -> None:
    found = bounces(continued=False)
    distance, light = found.cells(*CORNER)
    planes, fits, large = found.planes(distance)
    direct = torch.zeros(2, 1, len(distance)).double()
    direct[0] = 1.0
    ratio = found.indirect(planes, fits, large, light, direct, 1).reshape(2, 24, 32)
    # Patches of two pixels leave 3 % where the corner is some patches away.
    assert complex(*ratio[:, pixel[0], pixel[1]].tolist()) == pytest.approx(
        integral(pixel), rel=0.03
    )


def test_what_was_added_is_removed() -> None:
    found, (distance, light) = bounces(), CORNER
    measured, brighter = found.added(distance, light)
    shift = measured - distance
    assert shift.square().mean().sqrt() > 0.02
    assert (brighter > light).all()
    left = found.removed(measured, brighter) - distance
    assert left.square().mean() < 0.02 * shift.square().mean()  # After two rounds.
    # With more rounds the geometry is that of the direct light.
    left = found.removed(measured, brighter, rounds=6) - distance
    assert left.square().mean() < 0.002 * shift.square().mean()


def test_several_frequencies_are_removed_as_they_were_added() -> None:
    found, (distance, light) = bounces(frequencies_hz=(20e6, 60e6)), CORNER
    measured, brighter = found.added(distance, light)
    left = found.removed(measured, brighter, rounds=6) - distance
    assert left.square().mean() < 0.01 * (measured - distance).square().mean()


def test_a_lone_wall_stays_as_it_is() -> None:
    distance, light = walls(((0.2, 0.1, -0.9746794), 1.5))
    found = bounces(light_half_angle_deg=60.0)
    torch.testing.assert_close(found.removed(distance, light), distance, rtol=0, atol=1e-7)
    torch.testing.assert_close(found.added(distance, light)[0], distance, rtol=0, atol=1e-7)


def test_the_unit_of_the_amplitude_cancels() -> None:
    distance, light = CORNER
    expected = bounces().removed(distance, light)
    found = bounces(gain=GAIN / 40).removed(distance, 40 * light)
    torch.testing.assert_close(found, expected)


def test_a_board_between_two_walls_hides_them_from_each_other() -> None:
    found = bounces()
    distance, light = walls(((0, 0, -1.0), 2.0), ((1.0, 0, 0), 0.9), ((-1.0, 0, 0), 0.9))
    across = ray_directions(CAMERA)[..., 0] / ray_directions(CAMERA)[..., 2]
    hidden = torch.where(across.abs() < 0.12, 1.2 / ray_directions(CAMERA)[..., 2], distance)

    def free(image: Tensor) -> Tensor:
        planes, _, _ = found.planes(found.cells(image, light)[0])
        place, normal, _, _, area = found.surfaces(planes, found.cell_rays, found.solid)
        first, second = (
            part.reshape(-1, 24, 32)[:, 1::2, 1::2].reshape(-1, 192) for part in (place, normal)
        )
        return found.unhidden(first, second, area.reshape(24, 32)[1::2, 1::2].reshape(-1))

    left, right = 6 * 16 + 1, 6 * 16 + 14
    assert free(distance)[left, right]
    assert not free(hidden)[left, right]


ROOM = [
    {"corners": [[1.8, -3, 0.1], [-1.5, -3, 3.4], [-1.5, 3, 3.4], [1.8, 3, 0.1]]},
    {"corners": [[-1.5, -3, 0.05], [1.5, -3, 3.05], [1.5, 3, 3.05], [-1.5, 3, 0.05]]},
]
"""A room of two walls that meet ahead, in the camera's axes."""


def room(**changed: object) -> SecondBounces:
    values = STATE.to_mapping() | {"room": ROOM, "continued": False, **changed}
    return SecondBounces(CAMERA, SecondBouncesState.model_validate(values)).double()


def in_room(found: SecondBounces) -> tuple[Tensor, Tensor]:
    """Distances and light of the room's walls, of a reflectivity of one half."""
    found.room.set_pose(torch.eye(4))
    planes, _ = found.room.met(found.rays.reshape(3, -1))
    near = (planes * found.rays.reshape(3, -1)).sum(0).reshape(24, 32)
    cosine = near / planes.norm(dim=0).reshape(24, 32)
    return 1 / near, 0.5 / (math.pi * GAIN) * cosine * near**2


def test_a_room_in_the_world_is_that_in_the_camera_from_its_pose() -> None:
    still, moved = room(room_axes="camera"), room()
    distance, light = in_room(still)
    pose = torch.eye(4).double()
    pose[:3, :3] = torch.linalg.matrix_exp(torch.tensor([[0, -1, 2], [1, 0, 3], [-2, -3, 0]]) / 4.0)
    pose[:3, 3] = torch.tensor([1.0, -2.0, 0.5])
    turned = [
        {"corners": (torch.tensor(f["corners"]).double() @ pose[:3, :3].T + pose[:3, 3]).tolist()}
        for f in ROOM
    ]
    expected = still.removed(distance, light)
    moved = room(room=turned)
    moved.room.set_pose(pose)
    torch.testing.assert_close(moved.removed(distance, light), expected, rtol=0, atol=1e-5)


def test_a_room_sends_light_from_beyond_the_image() -> None:
    wide = {"light_half_angle_deg": 60.0, "room_axes": "camera"}
    whole, none = room(**wide), room(room=[], **wide)
    distance, light = in_room(whole)
    more = whole.added(distance, light)[0] - none.added(distance, light)[0]
    assert (more > 0).all()
    # Continued planes of the frame are those of the room.
    continued = room(room=[], continued=True, **wide).added(distance, light)[0]
    assert (whole.added(distance, light)[0] - continued).abs().max() < 0.1 * more.max()


def test_without_a_pose_the_room_of_a_world_is_not_used() -> None:
    distance, light = in_room(room())  # Of another one, with a pose.
    torch.testing.assert_close(
        room().removed(distance, light), room(room=[]).removed(distance, light)
    )


def test_planes_of_frames_are_put_together_in_the_world() -> None:
    poses = torch.eye(4).double().repeat(3, 1, 1)
    poses[1:, :3, 3] = torch.tensor([[0.1, 0.0, -0.1], [-0.05, 0.2, 0.0]])
    frames = []
    for pose in poses:
        moved = room()
        moved.room.set_pose(pose)
        planes, _ = moved.room.met(moved.rays.reshape(3, -1))
        near = (planes * moved.rays.reshape(3, -1)).sum(0)
        light = 0.5 / (math.pi * GAIN) * near**3 / planes.norm(dim=0)
        frames.append((1 / near.reshape(24, 32), light.reshape(24, 32)))
    none = room(room=[], gain=GAIN / 1e3)  # Hardly any bounces: these distances are direct.
    faces = recorded_room(none, frames, poses)
    assert len(faces) == 2
    for face in faces:
        corners = torch.tensor(face.corners).double()
        off = [
            ((corners - torch.tensor(f["corners"][0]).double()) @ torch.tensor(n).double())
            .abs()
            .max()
            for f, n in zip(ROOM, ((1, 0, 1), (-1, 0, 1)), strict=True)
        ]
        assert min(off) < 1e-4  # A thousandth of what the bounces would add.


def test_a_budget_makes_patches_larger_or_is_refused() -> None:
    depth, light = (image.float()[None] for image in CORNER)
    values = {"frequencies_hz": (FREQUENCY,), "gain": GAIN}
    assert patch_within(1e6, values, state_with_bounces(), depth, light) == 2
    with pytest.raises(CalibrationDataError, match="budget_ms"):
        patch_within(1e-3, values, state_with_bounces(), depth, light)


def test_a_bent_face_is_refused() -> None:
    bent = [{"corners": [[0, 0, 1], [1, 0, 1], [1, 1, 2], [0, 1, 1]]}]
    with pytest.raises(ValueError, match="flat and convex"):
        room(room=bent)


def test_pixels_without_a_return_stay_without() -> None:
    distance, light = (image.clone() for image in CORNER)
    distance[3:6, 4:9] = torch.nan
    found = bounces().removed(distance, light)
    assert torch.equal(found.isnan(), distance.isnan())


def test_scripted_it_removes_the_same() -> None:
    found = SecondBounces(CAMERA, STATE)
    frames = [image.float().repeat(2, 1, 1) for image in CORNER]
    assert torch.equal(torch.jit.script(found)(*frames), found(*frames))


HERE = torch.eye(4).expand(6, 4, 4)
"""Poses of six frames that no room needs."""


def frames_of_walls(generator: Generator) -> list[tuple[Tensor, Tensor]]:
    """Walls beside each other, with second bounces and a base error, at different distances."""
    found, frames = bounces(), []
    for k in range(6):
        direct = walls((LEFT, 1.1 + 0.1 * k), (RIGHT, 1.6 - 0.1 * k))
        distance, light = found.added(*direct)
        distance = distance + 0.02 * torch.sin(3.0 * distance)
        noise = 1e-3 * torch.randn(distance.shape, generator=generator).double()
        frames.append((distance + noise, light))
    return frames


def base_error(distance: Tensor, _amplitude: Tensor) -> Tensor:
    return torch.stack([torch.sin(3.0 * distance), torch.cos(3.0 * distance)])


def test_the_gain_is_found_beside_a_base_error(generator: Generator) -> None:
    found = bounces(gain=GAIN / 2)
    fit = fit_gain(found, frames_of_walls(generator), base_error, HERE)
    low, high = fit.interval
    assert low < fit.gain < high
    # The base error acts on what second bounces have lengthened, and its columns do not: its
    # slope, 0.06.
    assert fit.gain == pytest.approx(GAIN, rel=0.06, abs=2 * fit.standard_error)
    assert fit.coefficients[0] == pytest.approx(0.02, abs=0.01)
    assert found.gain == GAIN / 2


def test_without_second_bounces_no_gain_is_found(generator: Generator) -> None:
    frames = []
    for k in range(6):
        distance, light = walls(((0.2, 0.1 * k, -0.9), 1.0 + 0.1 * k))
        noise = 1e-3 * torch.randn(distance.shape, generator=generator).double()
        frames.append((distance + noise, light))
    with pytest.raises(CalibrationDataError, match="Record walls with"):
        fit_gain(bounces(), frames, base_error, HERE)


def state_with_bounces() -> CalibrationState:
    domain = replace(DOMAIN, width=32, height=24)
    scene = {"second_bounces": STATE.to_mapping()}
    return calibration(camera=CAMERA, domain=domain, scene=scene)


def test_the_corrector_removes_them_after_its_own_error(tmp_path: Path) -> None:
    state = state_with_bounces()
    plain = state.model_copy(update={"scene": SceneLight()})
    depth, light = (image.float() for image in CORNER)
    ray_z = ray_directions(CAMERA)[..., 2].float()
    slant = ray_z if state.depth_kind == "z" else torch.ones_like(ray_z)
    corrected, valid = DepthCorrector.from_state(plain)(depth * slant, light)
    found = DepthCorrector.from_state(state)(depth * slant, light)
    expected = SecondBounces(CAMERA, STATE)(corrected / slant, light) * slant
    torch.testing.assert_close(found[0], expected, rtol=0, atol=1e-5)
    assert torch.equal(found[1], valid)
    write("torchscript", state, tmp_path / "corrector.ts")


@pytest.mark.parametrize("name", ["lut", "pt2", "c", "onnx"])
def test_other_formats_refuse_them_in_words(name: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"holds no second_bounces: export torchscript\."):
        write(name, state_with_bounces(), tmp_path / "corrector.pt2")


def test_a_sensor_adds_what_is_removed() -> None:
    content = {
        "format": "tofcorr-sensor",
        "version": 1,
        "camera": CAMERA.section(),
        "depth_kind": "radial",
        "validity": {"radial_distance_m": (0.5, 4.0)},
    }
    plain = SensorModel(SensorFile.model_validate(content), torch.float64)
    content["second_bounces"] = STATE.to_mapping()
    sensor = SensorModel(SensorFile.model_validate(content), torch.float64)
    distance, light = CORNER
    expected, brighter = bounces().added(distance, light)
    seen = sensor(distance, light, noise=False)
    torch.testing.assert_close(seen.depth, expected)
    torch.testing.assert_close(seen.amplitude, brighter)
    assert torch.equal(plain(distance, light, noise=False).depth, distance)


def test_a_scripted_corrector_takes_the_pose_of_each_frame() -> None:
    mounted = torch.eye(4).double()
    mounted[:3, 3] = torch.tensor([0.02, -0.05, 0.1])
    scene = {"second_bounces": STATE.to_mapping() | {"room": ROOM, "continued": False}}
    state = state_with_bounces().model_copy(
        update={"scene": SceneLight.model_validate(scene), "tool_from_camera": mounted}
    )
    poses = torch.eye(4).double().repeat(2, 1, 1)
    poses[1, :3, 3] = torch.tensor([0.1, 0.0, -0.2])
    depth, light = (image.float().repeat(2, 1, 1) for image in CORNER)
    corrector, compiled = (DepthCorrector.from_state(state) for _ in range(2))
    compiled = torch.jit.script(compiled)
    compiled.set_pose(poses)
    both = compiled(depth, light)[0]
    for frame, pose in enumerate(poses):
        corrector.set_pose(pose)
        torch.testing.assert_close(corrector(depth[frame], light[frame])[0], both[frame])
    assert not torch.equal(both[0], both[1])
