"""A calibration that grows frame by frame, against one of the finished recording."""

import json
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from optional import present
from simulated_walls import simulated_wall

import tofcorr
from tofcorr.fit.problem import Fit
from tofcorr.geometry import se3
from tofcorr.live.calibration import Known, LiveCalibration
from tofcorr.live.frames import seen_from
from tofcorr.pixels.dataset import Dataset
from tofcorr.training.advice import Workspace

CONFIG = {
    "name": "live",
    "model": {
        "terms": [
            {"kind": "distance_polynomial", "degree": 3},
            {"kind": "pixel_polynomial", "degree": 2},
            {"kind": "amplitude_polynomial", "variable": "amplitude", "degree": 2},
        ]
    },
    "split": {"test_fraction": 0.0},
}


@pytest.fixture(scope="module")
def wall(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    folder = tmp_path_factory.mktemp("live") / "wall"
    return simulated_wall(folder, shots=(("white", 12), ("checkerboard", 12)))


def add(live: LiveCalibration, wall: Dataset, k: int, *, with_plane: bool = True) -> Known:
    recording, at = wall.first, np.array([k])
    row = recording.frames.row(k)
    plane = np.append(row.normal_world, row.offset) if with_plane else None
    depth, amplitude = (recording.read(name, at) for name in ("depth", "amplitude"))
    assert depth is not None
    assert amplitude is not None
    pose, named = row.world_from_tool, {"target": row.target, "timestamp": row.timestamp}
    return live.add(depth[0], amplitude[0], pose, plane=plane, **named)


def same(one: Fit, other: Fit, most: float = 1e-9) -> None:
    found, expected = one.solution.parameters, other.solution.parameters
    shift = (found.tool_from_camera - expected.tool_from_camera).abs().max()
    assert float(shift) < most
    assert torch.allclose(found.coefficients, expected.coefficients, rtol=0, atol=most)
    assert torch.allclose(one.covariance.matrix, other.covariance.matrix, rtol=1e-4, atol=1e-12)


# With few pixels in all, lattices are thinned while frames come, and by train at once.
@pytest.mark.parametrize(("seed", "pixels"), [(0, 2**20), (1, 2**20), (2, 2**14)])
def test_it_is_what_train_finds_whatever_the_order(
    wall: Dataset, seed: int, pixels: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tofcorr.pixels.lattice._MOST_OF_ALL", pixels)
    live = LiveCalibration(wall.first, CONFIG)
    for k in np.random.default_rng(seed).permutation(wall.num_frames):
        add(live, wall, int(k))
    trained = tofcorr.train(wall.first, CONFIG)
    same(live.result(), trained.fit)
    known = live.known
    assert known is not None
    assert known.fit is not None
    apart = se3.apart(known.fit.optimum.tool_from_camera, trained.fit.optimum.tool_from_camera)
    assert apart == pytest.approx((0, 0), abs=2e-4)  # What the ranges change of it.


@pytest.fixture(scope="module")
def long_wall(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    folder = tmp_path_factory.mktemp("live") / "long"
    return simulated_wall(folder, shots=(("white", 30), ("checkerboard", 30)))


@pytest.mark.slow
def test_sixty_frames_in_any_order_are_what_train_finds(long_wall: Dataset) -> None:
    trained = tofcorr.train(long_wall.first, CONFIG).fit
    for seed in range(5):
        live = LiveCalibration(long_wall.first, CONFIG)
        for k in np.random.default_rng(seed).permutation(long_wall.num_frames):
            add(live, long_wall, int(k))
        same(live.result(), trained)


# A process that adds ten frames to what is there, and is killed.
KILLED = """
import json, os, signal, sys
import tofcorr
recording, folder = tofcorr.Recording.open(sys.argv[1]), sys.argv[2]
if os.path.exists(folder):
    live = tofcorr.LiveCalibration.resume(folder)
else:
    live = tofcorr.LiveCalibration(recording, json.loads(sys.argv[3]), folder=folder)
for k in range(len(live), len(live) + 10):
    images = recording.depth[k], recording.amplitude[k]
    live.add_frame(recording.frames.row(k), *images, plane_is_known=True)
os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.slow
def test_a_process_that_is_killed_after_every_tenth_frame_loses_nothing(
    long_wall: Dataset, tmp_path: Path
) -> None:
    given = [str(long_wall.first.path), str(tmp_path / "live"), json.dumps(CONFIG)]
    for _ in range(6):
        ended = subprocess.run([sys.executable, "-c", KILLED, *given], check=False)
        assert ended.returncode == -signal.SIGKILL
    live, again = LiveCalibration(long_wall.first, CONFIG), LiveCalibration.resume(given[1])
    for k in range(60):
        add(live, long_wall, k)
    assert len(again) == 60
    same(again.result(), live.result())


def test_walls_that_nobody_measured_are_estimated(wall: Dataset) -> None:
    live = LiveCalibration(wall.first, CONFIG)
    for k in range(wall.num_frames):
        add(live, wall, k, with_plane=False)
    starts = {one.row.target: one.row for one in live._frames.values()}
    table = wall.first.frames
    rows = [starts[name] for name in table.target]
    planes = {
        "normal_world": np.stack([row.normal_world for row in rows]),
        "offset": np.array([row.offset for row in rows]),
    }
    recording = replace(wall.first, frames=replace(table, **planes), planes="estimated")
    # A millionth of a standard error, at which the solver stops, is some nanometres here.
    same(live.result(), tofcorr.train(recording, CONFIG).fit, most=1e-7)


def test_a_camera_that_stands_still_determines_no_hand_eye_transform(wall: Dataset) -> None:
    live = LiveCalibration(wall.first, CONFIG | {"model": {"terms": []}})
    for k in range(4):
        row = wall.first.frames.row(k)
        depth, amplitude = (wall.first.read(name, np.array([k])) for name in ("depth", "amplitude"))
        assert depth is not None
        assert amplitude is not None
        camera = row.world_from_tool @ wall.first.tool_from_camera
        normal, offset = row.normal_world @ camera[:3, :3], row.normal_world @ camera[:3, 3]
        plane = np.append(normal, row.offset + offset)
        live.add(depth[0], amplitude[0], np.eye(4), plane=plane)
    assert live.known is not None
    assert live.known.fit is not None
    assert not live.known.is_determined


def test_a_removed_frame_was_never_there(wall: Dataset) -> None:
    one, other = LiveCalibration(wall.first, CONFIG), LiveCalibration(wall.first, CONFIG)
    for k in range(10):
        add(one, wall, k)
        if k != 4:
            add(other, wall, k)
    one.remove(4)
    same(one.result(), other.result())
    with pytest.raises(tofcorr.CalibrationDataError, match="no frame 4"):
        one.remove(4)


def test_frames_that_lie_on_disk_count_like_those_in_memory(
    wall: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tofcorr.live.calibration._MOST_FITTED", 12)
    monkeypatch.setattr("tofcorr.live.calibration._MOST_COMPARED", 2)
    in_memory = LiveCalibration(wall.first, CONFIG)
    on_disk = LiveCalibration(wall.first, CONFIG, folder=tmp_path / "live")
    for live in (in_memory, on_disk):
        known = [add(live, wall, k) for k in range(wall.num_frames)]
        assert known[-1].poses == wall.num_frames
        # Fewer are fitted from the 13th on, and all are counted.
        assert len(present(known[-1].fit).moments.count) < 14
        assert known[-1].translation_mm < 1.5 * known[11].translation_mm
    assert (len(in_memory._sums), len(on_disk._sums) < 17) == (wall.num_frames, True)
    same(on_disk.result(), in_memory.result(), most=1e-12)
    absent = next(k for k in range(wall.num_frames) if k not in on_disk._sums)
    for live in (in_memory, on_disk):
        live.remove(absent)
    same(on_disk.result(), in_memory.result(), most=1e-12)


def test_what_was_added_is_there_after_a_crash(wall: Dataset, tmp_path: Path) -> None:
    live = LiveCalibration(wall.first.camera, CONFIG, folder=tmp_path / "live")
    for k in range(16):
        add(live, wall, k, with_plane=False)
    (tmp_path / "live" / ".half-written").write_bytes(b"0")
    again = LiveCalibration.resume(tmp_path / "live")
    assert len(again) == 16
    same(again.result(), live.result())
    add(again, wall, 16, with_plane=False)
    assert len(LiveCalibration.resume(tmp_path / "live")) == 17
    (tmp_path / "live" / "frame-000003.pt").write_bytes(b"nothing")
    with pytest.raises(tofcorr.CalibrationDataError, match="frame-000003"):
        LiveCalibration.resume(tmp_path / "live")


def test_intervals_shrink_and_the_next_pose_is_one_that_is_reachable(wall: Dataset) -> None:
    space = Workspace(nearest=1.0, farthest=1.1)
    live = LiveCalibration(wall.first, CONFIG, space=space)
    assert live.next_pose() is None
    first = [add(live, wall, k) for k in range(2)]
    assert all(not one.enough and np.isinf(one.translation_mm) for one in first)
    assert "not determined" in repr(first[-1])
    every = [add(live, wall, k) for k in range(2, wall.num_frames)]
    assert every[-1].translation_mm < every[9].translation_mm
    assert every[-1].poses == wall.num_frames
    pose = every[-1].next_pose()
    assert pose is not None
    distance, tilt, _ = seen_from(pose, live.frames[-1].row, live.tool_from_camera)
    assert space.nearest <= distance <= space.farthest
    assert tilt <= space.tilt_deg
    assert float(np.abs(pose[:3, :3] @ pose[:3, :3].T - np.eye(3)).max()) < 1e-9
    assert live.next_pose(lambda pose: bool(pose[2, 3] > 1e3)) is None
    live.wanted_mm, live.wanted_deg = 1e3, 90.0
    assert add(live, wall, 0).enough


@pytest.mark.parametrize("share", [1 / 50, 1 / 2])
def test_an_odd_frame_is_named_whether_or_not_it_is_fitted(
    wall: Dataset, share: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tofcorr.live.calibration._ONE_OF", share)
    live = LiveCalibration(wall.first, CONFIG)
    known = [add(live, wall, k) for k in range(20)]
    assert [one for one in known if one.odd] == []
    # Every frame from the third on is fitted; or those that double the frames: 4, 8 and 16.
    assert len({id(one.fit) for one in known if one.fit}) == (18 if share < 1 / 20 else 3)
    row = wall.first.frames.row(20)
    depth, amplitude = (wall.first.read(x, np.array([20])) for x in ("depth", "amplitude"))
    assert depth is not None
    assert amplitude is not None
    plane, pose = np.append(row.normal_world, row.offset), row.world_from_tool

    def odd(depth: np.ndarray, at: np.ndarray, time: float) -> tuple[str, ...]:
        found = live.add(depth, amplitude[0], at, plane=plane, target=row.target, timestamp=time)
        live.remove(found.frame)
        return found.odd

    bent = depth[0] + 0.3 * (np.arange(depth.shape[2]) > depth.shape[2] / 2)
    assert "shows no plane" in odd(bent.astype(np.float32), pose, 1e3)[0]
    off = pose.copy()
    off[:3, 3] += 0.4 * row.normal_world
    assert "disagrees" in odd(depth[0], off, 1e3)[0]
    late = wall.first.frames.timestamp[19] + 0.1
    assert "while the robot moved" in odd(depth[0], pose, late)[0]
    assert odd(depth[0], pose, 1e3) == ()


def test_bad_input_is_refused_and_nothing_is_lost(wall: Dataset) -> None:
    live = LiveCalibration(wall.first, CONFIG)
    add(live, wall, 0)
    size, pose = (wall.first.camera.height, wall.first.camera.width), np.eye(4)
    good = np.ones(size, np.float32)
    for depth, amplitude, said in [
        (good[1:], good, "expected shape"),
        (good * np.nan, good, "no pixel"),
        (good, None, "with every frame, or with none"),
        (good, -good, "amplitude"),
    ]:
        with pytest.raises(tofcorr.CalibrationDataError, match=said):
            live.add(depth, amplitude, pose, plane=np.array([0.0, 0, -1, 1]))
    with pytest.raises(tofcorr.CalibrationDataError, match="no condition"):
        live.add(good, good, pose, plane=np.array([0.0, 0, -1, 1]), exposure=3.0)
    assert len(live) == 1


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"weights": {"robust": "huber"}}, "weights.robust"),
        ({"model": {"terms": [{"kind": "distance_spline"}]}}, "depend on the range"),
        ({"model": {"terms": [{"kind": "fixed_pattern"}]}}, "fixed pattern"),
    ],
)
def test_what_needs_all_pixels_at_once_is_refused(wall: Dataset, change: dict, said: str) -> None:
    with pytest.raises(tofcorr.ConfigError, match=said):
        LiveCalibration(wall.first, CONFIG | change)


def test_the_saved_corrector_corrects(wall: Dataset, tmp_path: Path) -> None:
    live = LiveCalibration(wall.first, CONFIG)
    for k in range(wall.num_frames):
        add(live, wall, k)
    live.save(tmp_path / "run")
    corrector = tofcorr.load_corrector(tmp_path / "run")
    depth, amplitude = (
        torch.from_numpy(getattr(wall.first, name)[:1].copy()) for name in ("depth", "amplitude")
    )
    corrected, valid = corrector(depth, amplitude)
    expected, _ = live.state().corrected(depth, amplitude)
    assert torch.allclose(corrected[valid].double(), expected[valid].double(), atol=1e-5)
