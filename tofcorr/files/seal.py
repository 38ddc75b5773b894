"""A digest inside an archive that tofcorr wrote, so that a change of any byte is noticed."""

import io
import json
import lzma
import zipfile
import zlib
from hashlib import sha256
from pathlib import Path

from tofcorr.errors import CalibrationDataError

_RECORD = "extra/tofcorr_seal"

# What zipfile and the decompressors raise on a damaged archive.
_UNREADABLE = (OSError, ValueError, KeyError, EOFError, NotImplementedError, RuntimeError)
_UNREADABLE += (zipfile.BadZipFile, zlib.error, lzma.LZMAError, TypeError, MemoryError)

# Attribute of a folder in a zip archive, as DOS had it. torch takes what is marked so for empty and
# leaves the memory of its numbers as it was; zipfile reads it.
_FOLDER = 0x10

_MOST_BYTES = 2_000_000_000
"""Most bytes of all records, unpacked. Chosen: a small archive can be made to unpack to any size; a
fixed pattern of a camera of 16 megapixels takes 134 MB."""


def sealed(content: io.BytesIO) -> bytes:
    """Return a zip archive, such as torch.save and torch.jit.save write, with its digest added.

    Programs that do not know the added record ignore it. An archive is built in memory because
    torch's own writer ends the whole process where a disk is full.
    """
    with zipfile.ZipFile(content, "a") as archive:
        root = archive.namelist()[0].partition("/")[0]
        text = json.dumps({"sha256": _digest(archive)})
        # Of the earliest date that zip knows: the same content gives the same bytes at any time.
        archive.writestr(zipfile.ZipInfo(f"{root}/{_RECORD}"), text)
    return content.getvalue()


def refuse_damaged(path: Path, what: str) -> None:
    """Refuse an archive whose content is not what was written.

    Every record is compared with its own checksum. An archive with a seal is also compared with
    that; files of older versions have none.

    Args:
        path: The file.
        what: What it should be, for the message.

    Raises:
        CalibrationDataError: It is damaged, or was changed after it was written.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            sealed = [name for name in archive.namelist() if name.endswith(_RECORD)]
            found = _digest(archive)
            stored = json.loads(archive.read(sealed[0]))["sha256"] if sealed else found
    except FileNotFoundError:
        raise CalibrationDataError(f"{path}: there is no such file.") from None
    except IsADirectoryError:
        raise CalibrationDataError(f"{path}: is a folder; expected {what}, a file.") from None
    except _UNREADABLE:
        if not zipfile.is_zipfile(path):
            raise CalibrationDataError(f"{path}: is not {what}, or is cut short.") from None
        raise CalibrationDataError(f"{path}: is damaged; expected {what}.") from None
    if stored != found or len(sealed) > 1:
        raise CalibrationDataError(f"{path}: was changed after it was written; expected {what}.")


def _digest(archive: zipfile.ZipFile) -> str:
    """Return the digest of all records but the seal; reading compares their checksums."""
    digest = sha256()
    if sum(entry.file_size for entry in archive.infolist()) > _MOST_BYTES:
        raise ValueError("it unpacks to too much")
    if any(entry.external_attr & _FOLDER for entry in archive.infolist()):
        raise ValueError("a record is marked as a folder")
    names = archive.namelist()
    if len(set(names)) != len(names):
        raise ValueError("a record stands twice")
    for name in sorted(names):
        content = archive.read(name)
        if not name.endswith(_RECORD):
            # Without the first folder, which torch calls after the file.
            digest.update(f"{name.partition('/')[2]} {len(content)}\n".encode() + content)
    return digest.hexdigest()
