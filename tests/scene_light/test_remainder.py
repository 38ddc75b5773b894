"""A network learns what the removal of second bounces leaves, and stays within what it saw."""

import logging
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from correction.export.states import calibration, write
from kinds_of_terms import DOMAIN

from tofcorr.correction.corrector import DepthCorrector
from tofcorr.correction.state import CalibrationState, load_calibration, save_calibration
from tofcorr.geometry.camera import CameraIntrinsics
from tofcorr.geometry.rays import ray_directions
from tofcorr.scene_light.bounces import SecondBouncesState
from tofcorr.scene_light.drawn import Drawing, Drawn, Faces, drawn, train
from tofcorr.scene_light.remainder import RemainderOptions
from tofcorr.training.scene import RuntimeOptions, SecondBouncesWanted, with_remainder

CAMERA = CameraIntrinsics(
    width=32, height=24, matrix=((26.0, 0, 15.5), (0, 26.0, 11.5), (0, 0, 1.0))
)
STATE = SecondBouncesState(frequencies_hz=(20e6,), gain=1 / 500, patch_px=2)
QUIET = (1e-6, 0.0, 0.0)


@pytest.fixture(scope="module")
def drawing() -> Drawing:
    return Drawing(CAMERA, STATE, QUIET, width=2)


@pytest.fixture(scope="module")
def frames(drawing: Drawing) -> list[Drawn]:
    draw = np.random.default_rng(3)
    return [drawing.frame(draw) for _ in range(12)]


def test_a_ray_meets_the_nearest_face_as_geometry_says() -> None:
    near = Faces(torch.tensor([-1.0, -1, 2]), 2 * torch.eye(3)[:, :2], torch.tensor(0.5))
    far = Faces(torch.tensor([-9.0, -9, 3]), 18 * torch.eye(3)[:, :2], torch.tensor(0.25))
    both = Faces(*(torch.stack(pair).double() for pair in zip(far, near, strict=True)))
    rays = torch.tensor([[0.0, 0, 1], [0.6, 0, 0.8], [0, 0, -1]]).double().T
    planes, face, grey = both.met(rays)
    torch.testing.assert_close(1 / (planes * rays).sum(0)[:2], torch.tensor([2.0, 3.75]).double())
    assert face[:2].tolist() == [1, 0]
    assert grey[:2].tolist() == [0.5, 0.25]
    assert planes[:, 2].isnan().all()


def test_the_wide_view_holds_the_cameras_own(drawing: Drawing) -> None:
    own = [drawing.cut(axis) for axis in drawing.wide.rays]
    torch.testing.assert_close(torch.stack(own), drawing.own.cell_rays)
    assert float(drawing.wide.rays[2].min()) <= drawing.cosine


def test_scenes_of_a_seed_are_the_same_and_of_others_differ() -> None:
    first, again, other = (drawn(np.random.default_rng(seed)) for seed in (1, 1, 2))
    assert all(torch.equal(a, b) for a, b in zip(first, again, strict=True))
    assert first.corner.shape != other.corner.shape or not torch.equal(first.corner, other.corner)


def test_a_plane_fit_takes_off_what_moves_planes(drawing: Drawing, frames: list[Drawn]) -> None:
    moved = (drawing.own.cell_rays * frames[0].distance.square()).T @ torch.ones(3).double()
    assert float(drawing.flat(frames[0], 0.01 * moved).abs().nan_to_num(0.0).max()) < 1e-9


def trained(drawing: Drawing, frames: list[Drawn]) -> Drawing:
    torch.manual_seed(0)
    made = Drawing(CAMERA, STATE, QUIET, width=2)
    train(made.network, frames, np.random.default_rng(0))
    return made


def test_it_learns_what_is_a_function_of_the_frame(drawing: Drawing, frames: list[Drawn]) -> None:
    """Bounded by what it saw, and zero beyond the ranges of what it read."""
    taught = [
        frame._replace(left=0.05 * frame.read[1].tanh().double().reshape(-1) * frame.distance)
        for frame in frames
    ]
    network = trained(drawing, 3 * taught).network.requires_grad_(False)
    read = torch.stack([frame.read for frame in taught])
    share = torch.stack([f.left / f.distance for f in taught]).reshape(12, 24, 32)
    some = read[:, 0].abs().amax((1, 2)) > network.least
    known = share[some].isfinite()
    off = (network(read)[some] - share[some])[known]
    flat = share[some][known] - share[some][known].mean()
    assert off.square().mean() < 0.2 * flat.square().mean()
    wild = network(torch.randn(4, *read.shape[1:]) * 3)
    assert float(wild.abs().max()) <= float(share[share.isfinite()].abs().max())
    beyond = read.clone()
    beyond[:, 2] = network.high[2] + 0.11 * (network.high[2] - network.low[2]) / 2
    assert not network(beyond).any()


def test_frames_without_second_bounces_stay(drawing: Drawing, frames: list[Drawn]) -> None:
    made = trained(drawing, frames)
    distance = 2 / ray_directions(CAMERA)[..., 2]
    light = 0.5 / math.pi / STATE.gain / distance.square()
    plain = drawing.own.removed(distance, light)
    made.own.remainder = made.network
    torch.testing.assert_close(made.own.removed(distance, light), plain, rtol=0, atol=1e-6)


def state_with_bounces() -> CalibrationState:
    domain = replace(DOMAIN, width=32, height=24)
    scene = {"second_bounces": STATE.to_mapping()}
    return calibration(camera=CAMERA, domain=domain, scene=scene)


def test_training_keeps_it_only_if_it_helps(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    wanted = SecondBouncesWanted(gain=STATE.gain, learned=RemainderOptions(scenes=30, width=2))
    state = state_with_bounces()
    assert with_remainder(RuntimeOptions(second_bounces=None), state) is state
    with caplog.at_level(logging.INFO):
        found = with_remainder(RuntimeOptions(second_bounces=wanted), state)
    said = caplog.messages[-1]
    assert said.endswith("is kept." if found.remainder else "is not kept.")
    monkeypatch.setattr("tofcorr.scene_light.drawn.train", lambda *_: None)
    assert with_remainder(RuntimeOptions(second_bounces=wanted), state) is state  # Untrained.


def test_the_corrector_holds_it(drawing: Drawing, frames: list[Drawn], tmp_path: Path) -> None:
    remainder = {
        "options": {"width": 2},
        "left_mm": (2.0, 1.0),
        "flat_mm": (1.0, 0.5),
        "numbers": trained(drawing, frames).network.numbers(),
    }
    plain = state_with_bounces()
    state = plain.model_copy(update={"remainder": None})
    state = CalibrationState.model_validate(state.model_dump() | {"remainder": remainder})
    write("torchscript", state, tmp_path / "corrector.ts")
    save_calibration(tmp_path / "state.pt", state)
    state = load_calibration(tmp_path / "state.pt")
    rays = ray_directions(CAMERA)
    near = rays[..., 2] + rays[..., 0].abs()
    depth, light = (1.5 / near).float()[None], torch.full((1, 24, 32), 150.0)
    corrected = [DepthCorrector.from_state(one)(depth, light)[0] for one in (plain, state)]
    scripted = torch.jit.load(str(tmp_path / "corrector.ts"))(depth, light)[0]
    torch.testing.assert_close(scripted, corrected[1], rtol=0, atol=1e-5)
    assert float((corrected[1] - corrected[0]).abs().max()) > 1e-4
    assert "numbers" not in state.scene_mapping()["learned"]
