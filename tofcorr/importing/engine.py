"""From any source of images to a recording with `import.json` beside its arrays.

An importer implements `ImageSource`: it reads its views through a `Sieve`, which sets aside those
that cannot be used, and returns a `PreparedImport`. Writing and reporting are the same for all.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from tofcorr.data.table import FrameRow
from tofcorr.data.writing import RecordingWriter
from tofcorr.files.staged import StagedFolder
from tofcorr.geometry.camera import CameraIntrinsics
from tofcorr.importing import report
from tofcorr.importing.report import ImportedView, ImportReport
from tofcorr.importing.sieve import Progress, Sieve, no_progress
from tofcorr.options import Options


@dataclass(frozen=True, kw_only=True)
class ImportedFrame:
    """One frame, ready to be written; arguments of `RecordingWriter.append`."""

    row: FrameRow
    depth: np.ndarray
    amplitude: np.ndarray | None = None
    mask: np.ndarray | None = None


@dataclass(frozen=True, kw_only=True)
class PreparedImport:
    """All that an importer found out before frames are written.

    Attributes:
        views: What to report of each frame, in the order of the recording.
        frame: Reads the frame of this index.
        open_writer: Begins the recording in this folder.
        camera: What to report of the camera intrinsics (`camera_mapping`).
        findings: Further results, by their key in `import.json`.
        warnings: Sentences for people.
    """

    views: Sequence[ImportedView]
    frame: Callable[[int], ImportedFrame]
    open_writer: Callable[[Path], RecordingWriter]
    camera: dict[str, Any]
    findings: Mapping[str, Any] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)


class ImageSource(Protocol):
    """What an importer implements."""

    @property
    def folder(self) -> Path:
        """Where the images are."""
        ...

    @property
    def options(self) -> Options:
        """How to read them."""
        ...

    def prepare(self, sieve: Sieve) -> PreparedImport:
        """Read the views through `sieve` and find out everything but the frames themselves."""
        ...


def run_import(source: ImageSource, out: Path, progress: Progress = no_progress) -> ImportReport:
    """Turn the images of a source into a recording.

    Args:
        source: The images.
        out: The recording to write; it must not exist yet.
        progress: Shows how far a step has come.

    Raises:
        CalibrationDataError: No view can be used, the source contradicts itself, or `out` exists
            or cannot be written.
    """
    with StagedFolder(out) as stage:
        sieve = Sieve(str(source.folder), progress)
        prepared = source.prepare(sieve)
        result = ImportReport(
            folder=str(source.folder),
            options=source.options.to_mapping(),
            camera=prepared.camera,
            views=prepared.views,
            refused=sieve.refused,
            findings=prepared.findings,
            warnings=prepared.warnings,
        )
        _write(stage.folder, prepared, progress)
        (stage.folder / report.FILE_NAME).write_text(result.to_json(), encoding="utf-8")
    return result


def camera_mapping(camera: CameraIntrinsics, source: str) -> dict[str, Any]:
    """Return what `import.json` says of the camera intrinsics."""
    return {
        "source": source,
        "width": camera.width,
        "height": camera.height,
        "K": camera.matrix,
        "distortion": camera.distortion,
    }


def _write(folder: Path, prepared: PreparedImport, progress: Progress) -> None:
    """Write the files of the recording into `folder`, which exists."""
    inner = folder / "recording"
    with prepared.open_writer(inner) as writer:
        for index in progress(range(len(prepared.views)), "writing"):
            frame = prepared.frame(index)
            writer.append(frame.depth, row=frame.row, amplitude=frame.amplitude, mask=frame.mask)
    for path in inner.iterdir():
        path.rename(folder / path.name)
    inner.rmdir()
