"""`tofcorr correct` with a stand-in corrector that subtracts a constant."""

import filecmp
import json
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
from broken_recordings import value
from running import Program
from small_recordings import CAMERA, NUM_FRAMES, write_small_recording
from torch import Tensor, nn

from tofcorr.data.recording import Recording
from tofcorr.data.writing import write_corrected
from tofcorr.geometry.camera import CameraIntrinsics

CORRECT = ("correct", "--trust-model", "--model")
ERROR = 0.25
FARTHEST = 2.0


class ConstantCorrector(nn.Module):
    """Keeps the contract of a corrector; its error is a constant, its range ends at 2 m."""

    def __init__(self, metadata: str) -> None:
        super().__init__()
        self.text = metadata

    def forward(self, depth: Tensor, amplitude: Tensor) -> tuple[Tensor, Tensor]:
        if depth.shape[-1] != 7:
            raise ValueError("expected frames 7 pixels wide")
        returned = torch.isfinite(depth) & (depth > 0)
        corrected = torch.where(returned, depth - 0.25, torch.full_like(depth, float("nan")))
        return corrected, returned & (depth <= 2.0) & ~(amplitude < 0)

    @torch.jit.export
    def metadata(self) -> str:
        return self.text


def save_corrector(path: Path, **metadata: object) -> Path:
    camera = {"width": CAMERA.width, "height": CAMERA.height}
    text = json.dumps({"depth_kind": "radial", "camera": camera} | metadata)
    return save_module(path, ConstantCorrector(text))


def save_module(path: Path, module: nn.Module) -> Path:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        torch.jit.script(module).save(str(path))
    return path


@pytest.fixture
def source(tmp_path: Path) -> Path:
    return write_small_recording(tmp_path / "recording")


def test_depth_and_mask_are_corrected_and_all_else_stays(
    tmp_path: Path, program: Program, source: Path
) -> None:
    model = save_corrector(tmp_path / "corrector.ts")

    told = program(*CORRECT, model, "--recording", source, "--out", tmp_path / "out")
    assert told.code == 0

    before, after = Recording.open(source), Recording.open(tmp_path / "out")
    returned = np.isfinite(before.depth) & (before.depth > 0)
    expected = np.where(returned, before.depth - np.float32(ERROR), np.float32(np.nan))
    np.testing.assert_array_equal(after.depth, expected)
    kept = returned & (before.depth <= FARTHEST) & (before.mask == 1)
    np.testing.assert_array_equal(after.mask, kept)
    np.testing.assert_array_equal(after.amplitude, before.amplitude)
    assert after.raw is None
    assert after.depth_kind == before.depth_kind
    assert filecmp.cmp(source / "frames.csv", tmp_path / "out" / "frames.csv", shallow=False)
    share = kept.sum() / (returned & (before.mask == 1)).sum()
    assert f"{NUM_FRAMES} frames corrected; {share:.1%} of the pixels" in told.out
    assert "raw.npy was left out" in told.err


def test_what_was_corrected_is_not_corrected_again(
    tmp_path: Path, program: Program, source: Path
) -> None:
    """39 mm off, then 0.4, then -40, without a word."""
    model, once = save_corrector(tmp_path / "corrector.ts"), tmp_path / "once"
    assert program(*CORRECT, model, "--recording", source, "--out", once).code == 0
    told = program(*CORRECT, model, "--recording", once, "--out", tmp_path / "twice")
    assert told.code == 2
    assert "once: its depth was corrected already, by tofcorr" in told.err
    clouds = program(*CORRECT, model, "--recording", once, "--ply", tmp_path / "twice")
    assert (clouds.code, clouds.err) == (2, told.err)
    assert not (tmp_path / "twice").exists()
    assert "was corrected already" in program("inspect", once).out


def test_point_clouds_may_be_written_instead_of_a_recording(
    tmp_path: Path, program: Program, source: Path
) -> None:
    model = save_corrector(tmp_path / "corrector.ts")
    given = (*CORRECT, model, "--recording", source)
    assert program(*given, "--ply", tmp_path / "clouds").code == 0
    names = sorted(path.name for path in (tmp_path / "clouds").iterdir())
    assert names[:2] == ["frame_000_after.ply", "frame_000_before.ply"]
    assert len(names) == 2 * NUM_FRAMES
    code, _, told = program(*given)
    assert code == 2
    assert "give --out, --ply, or both" in told


def test_the_batch_size_does_not_change_the_result(tmp_path: Path, source: Path) -> None:
    recording = Recording.open(source)
    corrector = ConstantCorrector("{}")
    steps: list[int] = []

    def counted(depth: Tensor, amplitude: Tensor) -> tuple[Tensor, Tensor]:
        steps.append(len(depth))
        return corrector(depth, amplitude)

    for name, pixels in {"one": 1, "three": 3 * 35, "all": 10**6}.items():
        write_corrected(counted, recording, tmp_path / name, chunk_pixels=pixels)
    assert steps == [1, 1, 1, 1, 1, 1, 3, 3, 6]
    for other in ("three", "all"):
        for name in ("depth.npy", "mask.npy", "amplitude.npy", "frames.csv", "recording.yaml"):
            assert filecmp.cmp(tmp_path / "one" / name, tmp_path / other / name, shallow=False)


def test_a_model_without_intensity_term_corrects_a_recording_without_amplitude(
    tmp_path: Path, program: Program
) -> None:
    source = write_small_recording(tmp_path / "recording", amplitude=None)
    model = save_corrector(tmp_path / "corrector.ts", needs_amplitude=False)
    assert program(*CORRECT, model, "--recording", source, "--out", tmp_path / "out").code == 0
    assert Recording.open(tmp_path / "out").amplitude is None


def test_another_lens_is_remarked_upon(tmp_path: Path, program: Program, source: Path) -> None:
    lens = {"K": [list(row) for row in CAMERA.matrix], "distortion": list(CAMERA.distortion)}
    size = {"width": CAMERA.width, "height": CAMERA.height}
    other = lens | {"distortion": [0.0, 0.0, 0.0, 0.0]}
    for name, described, remarked in (("same", lens, False), ("other", other, True)):
        model = save_corrector(tmp_path / f"{name}.ts", camera=size | described)
        code, _, told = program(*CORRECT, model, "--recording", source, "--out", tmp_path / name)
        assert code == 0
        assert ("another lens calibration" in told) is remarked


class Nameless(nn.Module):
    """A TorchScript module that is no corrector."""

    def forward(self, depth: Tensor) -> Tensor:
        return depth


def test_what_does_not_fit_is_refused_in_one_line_and_leaves_nothing(
    tmp_path: Path, program: Program, source: Path
) -> None:
    without_amplitude = write_small_recording(tmp_path / "dark", amplitude=None)
    negative = write_small_recording(tmp_path / "negative")
    value("amplitude", (3, 0, 0), -1.0)(negative)
    turned = write_small_recording(
        tmp_path / "turned",
        camera=CameraIntrinsics(width=5, height=7, matrix=CAMERA.matrix),
        **dict.fromkeys(("depth", "amplitude"), np.ones((6, 7, 5))),
        **dict.fromkeys(("mask", "raw")),
    )
    corrector = save_corrector(tmp_path / "corrector.ts", needs_amplitude=False)
    needs_amplitude = save_corrector(tmp_path / "amplitude.ts")
    along_axis = save_corrector(tmp_path / "z.ts", depth_kind="z")
    silent = save_module(tmp_path / "silent.ts", ConstantCorrector("{}"))
    nameless = save_module(tmp_path / "nameless.ts", Nameless())
    garbage = tmp_path / "garbage.ts"
    garbage.write_bytes(b"no module at all")
    pickled = tmp_path / "weights.pt"
    torch.save({"weight": torch.ones(2)}, pickled)
    cases = [
        (tmp_path / "none.ts", source, "none.ts: there is no such file"),
        (tmp_path, source, "state.pt: there is no such file"),
        (corrector, garbage, "garbage.ts: is a file; a recording is a folder"),
        (garbage, source, "garbage.ts: is not a file of tofcorr train or export"),
        (pickled, source, "weights.pt: is not a calibration"),
        (nameless, source, "nameless.ts: without a corrector's metadata"),
        (along_axis, source, "depth is of kind 'radial', but"),
        (corrector, turned, "frames are 5x7 pixels, but"),
        (needs_amplitude, without_amplitude, "amplitude.npy is missing; the corrector"),
        # Metadata that does not tell the size: the module itself refuses, and is quoted.
        (silent, turned, "expected frames 7 pixels wide"),
        (corrector, negative, "amplitude.npy: frame 3, row 0, column 0: -1; expected 0 to"),
    ]
    before = sorted(tmp_path.rglob("*"))
    for model, recording, message in cases:
        out = tmp_path / "out"
        code, _, told = program(*CORRECT, model, "--recording", recording, "--out", out)
        assert code == 2, message
        assert message in told
        assert "Traceback" not in told
        assert sorted(tmp_path.rglob("*")) == before
