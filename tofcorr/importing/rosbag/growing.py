"""A bag that is still being written: read as far as its records are whole, and imported anew.

A recorder writes the index of an MCAP file, and the `metadata.yaml` of a folder, at the end. A
database can be read at any time, a ROS 1 bag when its index is there.
"""

import io
import os
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

from tofcorr.importing.posed import PosedImport
from tofcorr.importing.robot_images import PosedOptions, RobotImages
from tofcorr.importing.run import PreparedImport, Sieve
from tofcorr.importing.walls.image_planes import ImagePlane

_MAGIC = b"\x89MCAP0\r\n"
_FOOTER, _DATA_END = b"\x02", b"\x0f"
# The end of a file without an index: a footer of zeros (https://mcap.dev/spec).
_END = _FOOTER + (20).to_bytes(8, "little") + bytes(20) + _MAGIC


def is_whole(path: Path) -> bool:
    """Whether the recorder of a bag has said that it is complete; a database never says so."""
    if path.is_dir():
        return (path / "metadata.yaml").exists()
    if path.suffix != ".mcap":
        return path.suffix == ".bag"
    with path.open("rb") as file:
        file.seek(max(len(_MAGIC), file.seek(0, os.SEEK_END) - len(_MAGIC)))
        return file.read() == _MAGIC


def files_so_far(path: Path) -> list[Path]:
    """Return what a reader is to open of a bag: all of it, or its files as far as they go."""
    files = [path]
    if path.is_dir() and not is_whole(path):
        files = sorted(one for one in path.iterdir() if one.suffix in (".mcap", ".db3"))
    return [_SoFar(one) if one.suffix == ".mcap" and not is_whole(one) else one for one in files]


class _SoFar(type(Path())):
    """The path of an MCAP file that opens as its whole records and an end."""

    def open(self, *_: Any, **__: Any) -> Any:  # noqa: ANN401
        """Open the file for a reader of its bytes."""
        return _Ended(self)


class _Ended(io.FileIO):
    """An MCAP file up to its last whole record, and an end behind that."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._size, place = super().seek(0, os.SEEK_END), len(_MAGIC)
        while place <= self._size:
            self._whole = super().seek(place)
            head = super().read(9)
            if len(head) < 9 or head[:1] == _DATA_END:
                break
            place += 9 + int.from_bytes(head[1:], "little")
        super().seek(0)

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """Move as in a file that ends behind its last whole record."""
        if whence == os.SEEK_END:
            offset, whence = self._whole + len(_END) + offset, os.SEEK_SET
        return super().seek(offset, whence)

    def read(self, size: int | None = -1) -> bytes:
        """Read as of that file."""
        place = self.tell()
        last = self._whole + len(_END) if size is None or size < 0 else place + size
        content = super().read(max(0, min(last, self._whole) - place))
        end = _END[max(0, place - self._whole) : max(0, last - self._whole)]
        super().seek(place + len(content + end))
        return content + end


class GrowingBag:
    """A bag that is imported anew when it has grown, for half of the time at most.

    Args:
        path: The file or folder.
        opened: Opens it as far as it goes.

    Attributes:
        whole: Whether the recorder had ended it when it was imported last.
    """

    def __init__(
        self,
        path: Path,
        opened: Callable[[], AbstractContextManager[tuple[RobotImages, PosedOptions]]],
    ) -> None:
        self.path, self.whole, self._opened = path, False, opened
        self._size, self._rests_until = -1, 0.0
        self._planes: dict[str, list[ImagePlane]] = {}

    @contextmanager
    def so_far(self) -> Iterator[PreparedImport | None]:
        """Import what is there; None: it has not grown, or it is too early.

        Raises:
            CalibrationDataError: What is there so far cannot be imported; the message says why.
        """
        began, files = time.monotonic(), [self.path, *self.path.rglob("*")]
        size = sum(file.stat().st_size for file in files if file.is_file())
        if began < self._rests_until or size == self._size:
            yield None
            return
        self.whole = is_whole(self.path)
        try:
            with self._opened() as (images, options):
                yield PosedImport(images, options, self._planes).prepare(Sieve(images.origin))
        finally:
            self._size, self._rests_until = size, 2 * time.monotonic() - began
