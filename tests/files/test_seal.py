"""An archive that tofcorr wrote says whether it is still what was written."""

import io
import zipfile
from pathlib import Path

import pytest
import torch

from tofcorr.errors import CalibrationDataError
from tofcorr.files import refuse_damaged, sealed

VALUES = {"numbers": torch.arange(40, dtype=torch.float64), "name": "EA"}


@pytest.fixture
def content() -> bytes:
    buffer = io.BytesIO()
    torch.save(VALUES, buffer)
    return sealed(buffer)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "file"


def load(path: Path) -> dict:
    refuse_damaged(path, "a test")
    return torch.load(path, weights_only=True)


def test_every_flipped_bit_is_noticed_or_harmless(path: Path, content: bytes) -> None:
    path.write_bytes(content)
    assert torch.equal(load(path)["numbers"], VALUES["numbers"])
    # torch itself does not compare the checksums of an archive.
    noticed = 0
    for place in range(0, len(content), 7):
        flipped = content[place] ^ (1 << place % 8)
        path.write_bytes(content[:place] + bytes([flipped]) + content[place + 1 :])
        try:
            found = load(path)
        except (CalibrationDataError, RuntimeError):  # The second comes of torch.
            noticed += 1
        else:
            assert torch.equal(found["numbers"], VALUES["numbers"])
            assert found["name"] == "EA"
    assert noticed > 0


def test_a_record_marked_as_a_folder_is_refused(path: Path, content: bytes) -> None:
    # Found by the fuzz: torch leaves out such a record, and its numbers are whatever memory held.
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        before = content.index(b"PK\x01\x02", archive.start_dir)
    assert content[before + 38] == 0
    path.write_bytes(content[: before + 38] + b"\x10" + content[before + 39 :])
    with pytest.raises(CalibrationDataError, match="file: is damaged"):
        load(path)


def test_a_folder_in_place_of_the_file_is_called_so(tmp_path: Path) -> None:
    """The run folder, given as `--model` of `tofcorr correct`, was called a file cut short."""
    with pytest.raises(CalibrationDataError, match=r"is a folder; expected a test, a file\.$"):
        load(tmp_path)


@pytest.mark.parametrize("share", [0.0, 0.3, 0.9, 0.999])
def test_an_archive_that_was_cut_short_is_refused(path: Path, content: bytes, share: float) -> None:
    path.write_bytes(content[: int(share * len(content))])
    with pytest.raises(CalibrationDataError, match="file: is not a test, or is cut short"):
        load(path)


def test_a_record_changed_with_a_fitting_checksum_is_refused(path: Path, content: bytes) -> None:
    with zipfile.ZipFile(io.BytesIO(content)) as old, zipfile.ZipFile(path, "w") as new:
        for name in old.namelist():
            record = old.read(name)
            new.writestr(name, record[:-1] + b"\x01" if name.endswith("data/0") else record)
    with pytest.raises(CalibrationDataError, match="was changed after it was written"):
        load(path)


def test_an_archive_without_a_seal_is_compared_with_its_checksums_alone(tmp_path: Path) -> None:
    torch.save(VALUES, tmp_path / "old")
    assert load(tmp_path / "old")["name"] == "EA"
