"""The loops for cameras yield what the corrector gives, run against stand-ins for the drivers."""

import sys
from itertools import islice
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from examples.correctors import HEIGHT, WIDTH, frame, save_corrector
from examples.stand_ins import load_example

DEPTH_SCALE = 0.00025


def _frame(data: np.ndarray | None) -> Any:
    """Return a frame of pyrealsense2; one without data is false."""
    return None if data is None else SimpleNamespace(get_data=lambda: data)


class _Pipeline:
    """A pipeline of pyrealsense2 that gives prepared frames, one of them without infrared."""

    stopped = False

    def __init__(self) -> None:
        self.count = -1

    def start(self, config: Any) -> Any:
        kinds = (("depth", "z16"), ("infrared", "y8"))
        assert config.streams == [(name, WIDTH, HEIGHT, kind) for name, kind in kinds]
        sensor = SimpleNamespace(get_depth_scale=lambda: DEPTH_SCALE)
        device = SimpleNamespace(first_depth_sensor=lambda: sensor)
        return SimpleNamespace(get_device=lambda: device)

    def wait_for_frames(self) -> Any:
        self.count += 1
        depth, infrared = frame(self.count)
        infrared8 = None if self.count == 1 else (infrared // 4).astype(np.uint8)
        return SimpleNamespace(
            get_depth_frame=lambda: _frame((depth * 4).astype(np.uint16)),
            get_infrared_frame=lambda: _frame(infrared8),
        )

    def stop(self) -> None:
        _Pipeline.stopped = True


class _Config:
    def __init__(self) -> None:
        self.streams: list[tuple[Any, ...]] = []

    def enable_stream(self, stream: str, width: int, height: int, kind: str, rate: int) -> None:
        assert rate > 0
        self.streams.append((stream, width, height, kind))


def assert_corrected(loop: Any, model: Path, scale: float, dimmed: int) -> None:
    """The loop corrects the first and third frame, for the second lacks infrared, and ends."""
    corrector = torch.jit.load(str(model))
    for found, k in zip(islice(loop, 2), (0, 2), strict=True):
        depth, infrared = frame(k)
        metres = depth.astype(np.float32) * np.float32(scale)
        given = tuple(map(torch.from_numpy, (metres, np.float32(infrared // dimmed))))
        corrected, valid = corrector(*given)
        near = {"rtol": 0, "atol": 1e-6, "equal_nan": True}
        torch.testing.assert_close(found[0], corrected, **near)
        assert torch.equal(found[1], valid)
        torch.testing.assert_close(found[2], corrector.points(*given), **near)
    loop.close()


def test_realsense_loop_gives_corrected_frames(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    driver: Any = ModuleType("pyrealsense2")
    driver.pipeline, driver.config = _Pipeline, _Config
    driver.stream = SimpleNamespace(depth="depth", infrared="infrared")
    driver.format = SimpleNamespace(z16="z16", y8="y8")
    monkeypatch.setitem(sys.modules, "pyrealsense2", driver)
    model = save_corrector(tmp_path / "corrector.ts")
    loop = load_example("realsense").corrected_frames(str(model))
    assert_corrected(loop, model, 4 * DEPTH_SCALE, 4)
    assert _Pipeline.stopped
    assert capsys.readouterr().err.count("\n") == 1


class _PyK4A:
    """A camera of pyk4a; its second capture has no infrared image."""

    shape_of_depth: tuple[int, int] | None = None
    running = False

    def __init__(self, config: Any) -> None:
        assert config == ("off", "NFOV_UNBINNED")
        self.count = -1

    def start(self) -> None:
        _PyK4A.running = True

    def stop(self) -> None:
        _PyK4A.running = False

    def get_capture(self) -> Any:
        self.count += 1
        depth, infrared = frame(self.count)
        if self.shape_of_depth is not None:
            depth = np.ones(self.shape_of_depth, np.uint16)
        return SimpleNamespace(depth=depth, ir=None if self.count == 1 else infrared)


@pytest.fixture
def azure_kinect(monkeypatch: pytest.MonkeyPatch) -> Any:
    driver: Any = ModuleType("pyk4a")
    driver.PyK4A, driver.ColorResolution = _PyK4A, SimpleNamespace(OFF="off")
    driver.DepthMode = SimpleNamespace(NFOV_UNBINNED="NFOV_UNBINNED")
    driver.Config = lambda color_resolution, depth_mode: (color_resolution, depth_mode)
    monkeypatch.setitem(sys.modules, "pyk4a", driver)
    return load_example("azure_kinect")


def test_azure_kinect_loop_gives_corrected_frames(
    azure_kinect: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model = save_corrector(tmp_path / "corrector.ts")
    loop = azure_kinect.corrected_frames(str(model))
    assert_corrected(loop, model, 1e-3, 1)
    assert not _PyK4A.running
    assert capsys.readouterr().err.count("\n") == 1


def test_another_depth_mode_ends_the_loop_with_one_sentence(
    azure_kinect: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(_PyK4A, "shape_of_depth", (4, 4))
    model = save_corrector(tmp_path / "corrector.ts")
    with pytest.raises(SystemExit, match="4x4 pixels; the model is for another depth mode"):
        next(azure_kinect.corrected_frames(str(model)))
    assert not _PyK4A.running
