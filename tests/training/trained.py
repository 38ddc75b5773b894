"""One training of a simulated recording, for the tests of what it writes and says."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml
from synthetic_scene import EA

from tofcorr import TrainingResult
from tofcorr.pixels.dataset import Dataset

CONFIG: dict[str, Any] = {
    "name": "EA",
    "model": EA,
    "split": {"test_fraction": 0.4, "seed": 3},
    "advice": 2,
}
FILES = {
    *("calibration.yaml", "config.yaml", "corrector.ts", "reference.json"),
    *("report.html", "report.json", "state.pt", "tb"),
}


@dataclass(frozen=True)
class Trained:
    """One training of a simulated recording, and its run folder."""

    data: Dataset
    result: TrainingResult
    folder: Path

    @property
    def recording(self) -> Path:
        return self.data.first.path

    def report(self) -> dict[str, Any]:
        return json.loads((self.folder / "report.json").read_text())

    def calibration(self) -> dict[str, Any]:
        return yaml.safe_load((self.folder / "calibration.yaml").read_text())


def without_times(report: Mapping[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in report.items() if key != "seconds"}
