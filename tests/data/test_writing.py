"""A recording appears whole or not at all."""

import resource
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from small_recordings import CAMERA, frame_rows, small_images, write_small_recording

from tofcorr.data.recording import Recording
from tofcorr.data.writing import RecordingWriter
from tofcorr.errors import CalibrationDataError
from tofcorr.files import staged_folder
from tofcorr.geometry.camera import CameraIntrinsics


def contents(folder: Path) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


def write(
    path: Path,
    *frames: dict[str, Any],
    camera: CameraIntrinsics = CAMERA,
    end: type[BaseException] | None = None,
) -> None:
    """Write frames of ones beside what is given of each, and end by an error."""
    row = frame_rows(np.random.default_rng(0))[0]
    with RecordingWriter(path, camera=camera, depth_kind="radial") as writer:
        for frame in frames:
            writer.append(np.ones((camera.height, camera.width)), row=row, **frame)
            assert contents(path.parent) != []
            assert not path.exists()
        if end is not None:
            raise end


@pytest.mark.parametrize("interruption", [KeyboardInterrupt, RuntimeError, SystemExit])
def test_an_interrupted_write_is_undone(tmp_path: Path, interruption: type[BaseException]) -> None:
    with pytest.raises(interruption):
        write(tmp_path / "a" / "b", {"truth": {"x": np.ones(2)}}, end=interruption)
    assert contents(tmp_path) == []


def test_a_folder_that_appears_meanwhile_is_not_overwritten(tmp_path: Path) -> None:
    with (
        pytest.raises(CalibrationDataError, match="appeared there in the meantime"),
        staged_folder(tmp_path / "out"),
    ):
        (tmp_path / "out").mkdir()
    assert contents(tmp_path) == ["out"]


def test_a_full_disk_is_one_sentence_and_leaves_nothing(tmp_path: Path) -> None:
    # A limit on the size of a file answers as a full disk does: the write fails half-way.
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    camera = CameraIntrinsics(width=300, height=200, matrix=CAMERA.matrix)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2_000_000, before[1]))
    try:
        with pytest.raises(CalibrationDataError, match=r"full: cannot be written \(File too large"):
            write(tmp_path / "full", *20 * [{}], camera=camera)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert contents(tmp_path) == []


def _changed(part: str, value: float) -> dict[str, Any]:
    image = small_images(np.random.default_rng(0))[part]
    image[2, 0, 0] = value
    return {part: image}


def _with_row(**changes: Any) -> dict[str, Any]:
    rows = frame_rows(np.random.default_rng(0))
    rows[3] = replace(rows[3], **changes)
    return {"rows": rows}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"depth": np.ones((6, 4, 7))}, r"frame 0, depth: expected \(5, 7\), got \(4, 7\)"),
        ({"depth": np.ones((5, 5, 7))}, r"5 frames of depth, 6 rows"),
        (
            dict.fromkeys(("amplitude", "mask", "raw")) | {"depth": np.ones((0, 5, 7)), "rows": []},
            r"a recording of no frame",
        ),
        (_changed("amplitude", -1.0), r"amplitude\.npy: frame 2, row 0, column 0: -1; expected"),
        (_changed("mask", 7), r"mask\.npy: frame 2, row 0, column 0: 7; expected 0 or 1"),
        (_with_row(world_from_tool=2.0 * np.eye(4)), r"frame 3, world_from_tool: .*rigid"),
        (_with_row(world_from_tool=np.full((4, 4), np.nan)), r"frame 3, world_from_tool: .*finite"),
        (_with_row(normal_world=np.zeros(3)), r"frames\.csv: frame 3: the normal .* length 0"),
        (_with_row(offset=np.inf), r"frame 3, column 'd': expected a finite number"),
        (_with_row(target=""), r"frame 3, column 'target'"),
        (_with_row(target="two\nlines"), r"frame 3, column 'target': .*two\\nlines"),
        (_with_row(integration_time=0.0), r"frame 3, column 'integration_time_us': .*positive"),
        ({"depth_kind": "depth"}, r"'depth_kind'"),
        ({"modulation_frequency": -1.0}, r"'modulation_frequency_hz'"),
        ({"tool_from_camera": np.ones((4, 4))}, r"'tool_from_camera'"),
        ({"camera": replace(CAMERA, distortion=(0.1,))}, r"'camera\.distortion'"),
    ],
)
def test_what_the_reader_would_refuse_is_not_written(
    tmp_path: Path, changes: dict[str, Any], message: str
) -> None:
    with pytest.raises(CalibrationDataError, match=message) as refusal:
        write_small_recording(tmp_path / "recording", **changes)
    assert ".part" not in str(refusal.value)
    assert contents(tmp_path) == []


def test_an_image_given_for_some_frames_only_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CalibrationDataError, match="frame 1: give amplitude in all frames"):
        write(tmp_path / "recording", {"amplitude": np.ones((5, 7))}, {})
    assert contents(tmp_path) == []


def test_a_copy_with_too_few_frames_is_refused(tmp_path: Path) -> None:
    recording = Recording.open(write_small_recording(tmp_path / "recording"))
    with (
        pytest.raises(CalibrationDataError, match=r"copy/depth\.npy: has 1 frames; .* 6 rows"),
        RecordingWriter.like(tmp_path / "copy", recording) as writer,
    ):
        writer.append(recording.depth[0])
    assert not (tmp_path / "copy").exists()
