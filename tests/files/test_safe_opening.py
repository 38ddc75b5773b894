"""What a stranger hands over is opened without running it, without end, and in bounded memory."""

import os
import sys
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from examples.correctors import frame, save_corrector
from running import Program
from small_recordings import write_small_recording
from torch import Tensor, nn

from tofcorr.correction.lookup import read_lut
from tofcorr.correction.state import load_calibration
from tofcorr.data.recording import Recording
from tofcorr.errors import CalibrationDataError, TofcorrError
from tofcorr.files import open_regular
from tofcorr.importing.images import read_array
from tofcorr.module.loading import load_corrector
from tofcorr.options import read_text

READERS: dict[str, Callable[[Path], object]] = {
    "corrector.ts": load_corrector,
    "state.pt": load_calibration,
    "lut.npz": read_lut,
    "camera.yaml": read_text,
    "image.png": read_array,
    "image.npy": read_array,
    "image.exr": read_array,
    "image.hdf5": read_array,
}
PARTS = ("recording.yaml", "frames.csv", "depth.npy", "amplitude.npy", "mask.npy", "raw.npy")


class Writes(nn.Module):
    """A foreign corrector that writes into a file as soon as it is loaded."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.path, self.numbers = str(path), torch.zeros(8, dtype=torch.uint8)

    def forward(self, depth: Tensor) -> Tensor:
        return depth

    @torch.jit.export
    def __getstate__(self) -> tuple[str, bool]:  # pyright: ignore[reportIncompatibleMethodOverride]
        return self.path, self.training

    @torch.jit.export
    def __setstate__(self, state: tuple[str, bool]) -> None:
        self.path, self.training = state
        self.numbers = torch.from_file(self.path, True, 8, dtype=torch.uint8)
        self.numbers.zero_()


def test_a_foreign_program_is_not_run(tmp_path: Path, program: Program) -> None:
    victim, model = tmp_path / "victim", tmp_path / "foreign.ts"
    victim.write_bytes(b"precious")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        torch.jit.script(Writes(victim)).save(str(model))
    source = write_small_recording(tmp_path / "recording")
    told = program("correct", "--model", model, "--recording", source, "--out", tmp_path / "out")
    assert told.code == 2
    assert "holds a program and no calibration" in told.err
    assert victim.read_bytes() == b"precious"
    torch.jit.load(str(model))  # That it would have.
    assert victim.read_bytes() == bytes(8)


def test_the_corrector_built_anew_is_that_of_the_file(tmp_path: Path) -> None:
    model = save_corrector(tmp_path / "corrector.ts")
    depth, amplitude = (torch.from_numpy(one.astype(np.float32)) for one in frame())
    depth /= 1000
    for own, theirs in zip(
        load_corrector(model)(depth, amplitude),
        torch.jit.load(str(model))(depth, amplitude),
        strict=True,
    ):
        assert torch.equal(own.nan_to_num(-1), theirs.nan_to_num(-1))


@pytest.mark.parametrize("closed", [pytest.param("2>&-", marks=pytest.mark.slow), ">&- 2>&- <&-"])
def test_closed_streams_leave_the_work_as_it_is(closed: str, tmp_path: Path) -> None:
    """What was said went into the next file opened, or ended the command without a word."""
    model, out = save_corrector(tmp_path / "corrector.ts"), tmp_path / "out"
    source = write_small_recording(tmp_path / "recording", depth_kind="z")
    command = f"{sys.executable} -m tofcorr correct --model {model} --recording {source}"
    assert os.system(f"{command} --out {out} {closed}") == 0
    assert Recording.open(out).num_frames == Recording.open(source).num_frames


@pytest.mark.parametrize("kind", ["a pipe", "an endless device"])
@pytest.mark.parametrize("name", [*READERS, *PARTS])
def test_what_may_never_end_is_refused_at_once(name: str, kind: str, tmp_path: Path) -> None:
    folder = write_small_recording(tmp_path / "recording") if name in PARTS else tmp_path
    path = folder / name
    path.unlink(missing_ok=True)
    os.mkfifo(path) if kind == "a pipe" else path.symlink_to("/dev/zero")
    with pytest.raises(TofcorrError, match="no regular file"):
        READERS[name](path) if name in READERS else Recording.open(folder)


def test_a_file_beyond_its_limit_is_refused_unread(tmp_path: Path) -> None:
    with (tmp_path / "large").open("wb") as file:
        file.truncate(10**12)  # A hole, that takes no disk.
    with pytest.raises(OSError, match="larger than 500 MB"):
        open_regular(tmp_path / "large")


def test_a_tensor_larger_than_its_numbers_is_refused(tmp_path: Path) -> None:
    values = {"format": "tofcorr-calibration", "version": 1, "coefficients": torch.ones(1)}
    torch.save(values | {"state": [torch.ones(1).expand(10**9)]}, tmp_path / "state.pt")
    assert (tmp_path / "state.pt").stat().st_size < 5000
    with pytest.raises(CalibrationDataError, match="is not a calibration"):
        load_calibration(tmp_path / "state.pt")


def test_an_archive_that_unpacks_to_too_much_is_refused(tmp_path: Path) -> None:
    with (
        zipfile.ZipFile(
            tmp_path / "lut.npz", "w", zipfile.ZIP_DEFLATED, compresslevel=1
        ) as archive,
        archive.open("offset.npy", "w") as entry,
    ):
        for _ in range(600):
            entry.write(bytes(10**6))
    assert (tmp_path / "lut.npz").stat().st_size < 10**7
    with pytest.raises(CalibrationDataError, match="is not a look-up table"):
        read_lut(tmp_path / "lut.npz")


def test_bytes_behind_an_array_are_refused(tmp_path: Path) -> None:
    folder = write_small_recording(tmp_path / "recording")
    with (folder / "depth.npy").open("ab") as file:
        file.write(b"more")
    with pytest.raises(CalibrationDataError, match="4 bytes stand behind the array"):
        Recording.open(folder)
