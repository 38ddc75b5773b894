"""What an import did: views used, views refused, warnings."""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

from tofcorr.errors import CalibrationDataError

FILE_NAME = "import.json"


class RefusedViewError(CalibrationDataError):
    """One view cannot be used; the message says why, and the import goes on without it."""


@dataclass(frozen=True, kw_only=True)
class Refusal:
    """A view that is not in the recording, and why."""

    view: str
    reason: str


@dataclass(frozen=True, kw_only=True)
class ImportedView:
    """One frame of the recording; an importer adds fields of its own.

    Attributes:
        frame: Index in the recording.
        view: Name of the view in its source.
    """

    frame: int
    view: str


@dataclass(frozen=True, kw_only=True)
class ImportReport:
    """The result of an import; `import.json` beside the arrays.

    Attributes:
        folder: The source of the images.
        options: The options of the import.
        camera: The camera intrinsics used, and their source.
        views: The frames, in order.
        refused: The views left out.
        findings: Further results of the importer, by their key in `import.json`.
        warnings: Sentences for people.
    """

    folder: str
    options: dict[str, Any]
    camera: dict[str, Any]
    views: Sequence[ImportedView]
    refused: list[Refusal]
    findings: Mapping[str, Any] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)

    def to_json(self) -> str:
        """Return the text of `import.json`; a number that could not be measured is null."""
        content = {
            "format": "tofcorr-import",
            "version": 1,
            "folder": self.folder,
            "options": self.options,
            "camera": self.camera,
            "views": [asdict(view) for view in self.views],
            "refused": [asdict(refusal) for refusal in self.refused],
            **self.findings,
            "warnings": self.warnings,
        }
        text = json.dumps(_measured(content), indent=1, ensure_ascii=False, allow_nan=False)
        return text + "\n"


def _measured(value: Any) -> Any:  # noqa: ANN401 - of plain values
    """Return plain values with null for what is not a finite number, which JSON cannot hold."""
    if isinstance(value, Mapping):
        return {key: _measured(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [_measured(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
