"""Batches hold what the files hold, in the terms that fitting needs."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from broken_recordings import value as damaged
from hypothesis import given, settings
from hypothesis import strategies as st
from optional import present
from small_recordings import CAMERA, NUM_FRAMES, frame_rows, write_small_recording

from tofcorr.data.recording import FrameBatch, Recording, iterate_frames, valid_pixels
from tofcorr.data.writing import RecordingWriter
from tofcorr.errors import CalibrationDataError
from tofcorr.geometry.camera import CameraIntrinsics
from tofcorr.geometry.rays import ray_directions

PIXELS = CAMERA.width * CAMERA.height


@pytest.fixture(scope="module")
def radial(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    return Recording.open(write_small_recording(tmp_path_factory.mktemp("radial") / "recording"))


@pytest.fixture(scope="module")
def along_axis(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    path = tmp_path_factory.mktemp("z") / "recording"
    return Recording.open(write_small_recording(path, depth_kind="z"))


def joined(batches: list[FrameBatch], name: str) -> np.ndarray:
    return torch.cat([getattr(batch, name) for batch in batches]).numpy()


@settings(max_examples=25, deadline=None)
@given(
    indices=st.lists(st.integers(0, NUM_FRAMES - 1), max_size=12) | st.none(),
    chunk_pixels=st.integers(1, 8 * PIXELS),
)
def test_batches_agree_with_plain_numpy_whatever_the_chunk(
    radial: Recording, indices: list[int] | None, chunk_pixels: int
) -> None:
    batches = list(iterate_frames(radial, indices, chunk_pixels))
    chosen = np.arange(NUM_FRAMES) if indices is None else np.array(indices, dtype=int)
    if not len(chosen):
        assert batches == []
        return
    depth, amplitude, mask = (
        present(images)[chosen] for images in (radial.depth, radial.amplitude, radial.mask)
    )
    np.testing.assert_array_equal(joined(batches, "indices"), chosen)
    np.testing.assert_array_equal(joined(batches, "radial_distance"), depth.astype(np.float64))
    np.testing.assert_array_equal(joined(batches, "amplitude"), amplitude.astype(np.float64))
    expected = np.isfinite(depth) & (depth > 0) & (mask == 1) & (amplitude < 800.0)
    np.testing.assert_array_equal(joined(batches, "valid"), expected)
    assert all(b.valid.numel() <= max(chunk_pixels, PIXELS) for b in batches)


def test_depth_along_the_axis_becomes_distance_along_the_ray(along_axis: Recording) -> None:
    rays = ray_directions(along_axis.camera).numpy()
    batches = list(iterate_frames(along_axis))
    points = joined(batches, "radial_distance")[..., None] * rays
    # The definition of the z kind: the point's own z coordinate.
    np.testing.assert_allclose(points[..., 2], along_axis.depth, rtol=1e-15)


def test_planes_in_the_tool_frame_hold_the_same_points(radial: Recording) -> None:
    generator = np.random.default_rng(1)
    batches = list(iterate_frames(radial))
    normal, offset = joined(batches, "normal_tool"), joined(batches, "offset_tool")
    table = radial.frames
    for frame, pose in enumerate(table.world_from_tool):
        point_tool = generator.normal(size=3)
        point_world = pose[:3, :3] @ point_tool + pose[:3, 3]
        in_world = table.normal_world[frame] @ point_world + table.offset[frame]
        assert normal[frame] @ point_tool + offset[frame] == pytest.approx(in_world, abs=1e-14)


def test_float32_is_given_when_asked_for(along_axis: Recording) -> None:
    batch = next(iterate_frames(along_axis, image_dtype=torch.float32))
    assert {batch.radial_distance.dtype, present(batch.amplitude).dtype} == {torch.float32}
    assert {batch.normal_tool.dtype, batch.offset_tool.dtype} == {torch.float64}


def test_a_frame_that_is_not_there_is_named(radial: Recording) -> None:
    for wrong in (NUM_FRAMES, -1):
        with pytest.raises(IndexError, match=f"no frame {wrong}: the recording has 6"):
            next(iterate_frames(radial, [0, wrong]))


@pytest.mark.parametrize(("name", "value"), [("amplitude", -2.0), ("mask", 3)])
def test_what_opening_did_not_look_at_is_refused_while_streaming(
    folder: Path, name: str, value: float
) -> None:
    damaged(name, (5, 1, 2), value)(folder)
    recording = Recording.open(folder, check_contents=False)
    assert len(list(iterate_frames(recording, range(5)))) == 1
    with pytest.raises(CalibrationDataError, match=f"{name}.npy: frame 5, row 1, column 2"):
        list(iterate_frames(recording))


def test_a_file_that_shrinks_after_opening_is_refused(folder: Path) -> None:
    recording = Recording.open(folder)
    data = (folder / "depth.npy").read_bytes()
    (folder / "depth.npy").write_bytes(data[:-100])
    with pytest.raises(CalibrationDataError, match=r"depth\.npy: cannot be read .*shorter"):
        list(iterate_frames(recording))


def test_a_pixel_is_valid_if_it_returns_is_masked_in_and_not_saturated() -> None:
    nan, inf = float("nan"), float("inf")
    distance = torch.tensor([1.0, nan, inf, 0.0, -1.0, 1.0, 1.0, 1.0, 1.0])
    amplitude = torch.tensor([5.0, 5.0, 5.0, 5.0, 5.0, nan, 9.99, 10.0, 5.0])
    mask = torch.tensor([1, 1, 1, 1, 1, 1, 1, 1, 0])
    valid = valid_pixels(distance, amplitude, mask, 10.0)
    assert valid.nonzero().flatten().tolist() == [0, 6]
    assert valid_pixels(torch.ones(2, 3)).all()
    assert valid_pixels(torch.ones(2, 3), saturation_amplitude=5.0).all()


STREAM = """
import sys
from pathlib import Path
import torch
from tofcorr.data.recording import iterate_frames
from tofcorr.data.recording import Recording

def peak():
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM")) / 1024

recording = Recording.open(sys.argv[1], check_contents=False)
pixels = sum(b.valid.numel() for b in iterate_frames(recording, [0], chunk_pixels=200_000))
before = peak()
Recording.open(sys.argv[1])
pixels = sum(b.valid.numel() for b in iterate_frames(recording, chunk_pixels=200_000))
print(pixels, peak() - before)
"""


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="peak memory is read from /proc")
def test_streaming_needs_memory_for_a_chunk_and_not_for_the_recording(tmp_path: Path) -> None:
    camera = CameraIntrinsics(width=500, height=400, matrix=CAMERA.matrix)
    row = frame_rows(np.random.default_rng(0))[0]
    image = np.ones((400, 500), dtype=np.float32)
    with RecordingWriter(tmp_path / "long", camera=camera, depth_kind="radial") as writer:
        for _ in range(100):
            writer.append(image, row=row, amplitude=image)
    words = [sys.executable, "-c", STREAM, str(tmp_path / "long")]
    pixels, grown_mb = subprocess.check_output(words, text=True).split()
    assert int(pixels) == 100 * 400 * 500
    # The recording has 160 MB; opening reads pieces of 16 MB and a batch of 200 000 pixels has 5.
    assert float(grown_mb) < 80
