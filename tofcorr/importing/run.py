"""From any source of images to a recording with `import.json` beside its arrays.

An importer reads its views through a `Sieve`, which sets aside those that cannot be used, and
returns a `PreparedImport`: what is known before frames are written, and the frames themselves, one
at a time. Writing and reporting are the same for all (`run_import`).
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from tofcorr.data.table import FrameRow
from tofcorr.data.writing import RecordingWriter
from tofcorr.errors import CalibrationDataError
from tofcorr.files import staged_folder, write_json
from tofcorr.geometry.camera import CameraIntrinsics
from tofcorr.options import Options
from tofcorr.progress import through

FILE_NAME = "import.json"

Item = TypeVar("Item")
Result = TypeVar("Result")
Frame = tuple[FrameRow, np.ndarray, np.ndarray | None, np.ndarray | None]
"""Row, depth, amplitude and mask of one frame, as `RecordingWriter.append` takes them."""
Refused = dict[str, str]
"""Why views are not in the recording, by their names."""


class RefusedViewError(CalibrationDataError):
    """One view cannot be used; the message says why, and the import goes on without it."""


class Sieve:
    """Applies the steps of an import to its views and collects the refusals.

    Args:
        source: What the views are read from, for messages.

    Attributes:
        refused: The views refused so far, with reasons.
    """

    def __init__(self, source: str) -> None:
        self._source = source
        self.refused: Refused = {}

    def apply(
        self,
        step: Callable[[Item], Result],
        views: Sequence[Item],
        name: Callable[[Item], str],
        doing: str,
    ) -> list[Result]:
        """Apply `step` to each view, show how many have passed, and leave out those it refuses.

        Args:
            step: Raises `RefusedViewError` for a view that cannot be used.
            views: The views.
            name: Returns the name of a view, for its refusal.
            doing: What the step does, in a word or two.

        Raises:
            CalibrationDataError: No view is left.
        """
        results = []
        for view in through(views, doing, "view"):
            try:
                results.append(step(view))
            except RefusedViewError as refusal:
                self.refused[name(view)] = str(refusal)
        if not results:
            first = next(iter(self.refused.values()), "there are none")
            none = f"none of {len(self.refused)} views can be imported"
            raise CalibrationDataError(f"{self._source}: {none}: {first}.")
        return results


@dataclass(frozen=True, kw_only=True)
class PreparedImport:
    """All that an importer found out before frames are written.

    Attributes:
        views: What `import.json` says of each frame, in the order of the recording: `view`, its
            name in the source, and what the importer adds.
        frames: The frames, in the same order; they may be read as they are asked for.
        writer: Begins the recording in a folder.
        camera: What to report of the camera intrinsics (`camera_mapping`).
        findings: Further results, by their key in `import.json`.
        warnings: Sentences for people.
    """

    views: Sequence[Mapping[str, Any]]
    frames: Iterator[Frame]
    writer: partial[RecordingWriter]
    camera: Mapping[str, Any]
    findings: Mapping[str, Any] = field(default_factory=dict)
    warnings: Sequence[str] = ()


def run_import(
    source: str, options: Options, prepare: Callable[[Sieve], PreparedImport], out: Path
) -> dict[str, Any]:
    """Turn the images of a source into a recording, and return the content of its `import.json`.

    Args:
        source: Where the images are, for messages and the report.
        options: How they are read, for the report.
        prepare: Reads the views and finds out everything but the frames themselves.
        out: The recording to write; it must not exist yet.

    Raises:
        CalibrationDataError: No view can be used, the source contradicts itself, or `out` exists
            or cannot be written.
    """
    with staged_folder(out) as folder:
        sieve = Sieve(source)
        prepared = prepare(sieve)
        report = {
            "format": "tofcorr-import",
            "version": 1,
            "folder": source,
            "options": options.to_mapping(),
            "camera": prepared.camera,
            "views": [{"frame": number, **view} for number, view in enumerate(prepared.views)],
            "refused": [{"view": view, "reason": why} for view, why in sieve.refused.items()],
            **prepared.findings,
            "warnings": prepared.warnings,
        }
        inner = folder / "recording"
        written = through(prepared.frames, "writing", "view", len(prepared.views))
        with prepared.writer(inner) as writer:
            for row, depth, amplitude, mask in written:
                writer.append(depth, row=row, amplitude=amplitude, mask=mask)
        for path in inner.iterdir():
            path.rename(folder / path.name)
        inner.rmdir()
        write_json(folder / FILE_NAME, report)
    return report


def camera_mapping(camera: CameraIntrinsics, source: str) -> dict[str, Any]:
    """Return what `import.json` says of the camera intrinsics."""
    return {"source": source, **camera.section()}
