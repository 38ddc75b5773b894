"""What a comparison is asked, and recordings to ask it about."""

import shutil
from pathlib import Path
from typing import Any

import numpy as np

from tofcorr.comparison.options import EvaluationOptions
from tofcorr.data.recording import Recording


def options(*models: dict[str, Any], **common: Any) -> EvaluationOptions:
    values = {"models": list(models), "folds": 0} | common
    return EvaluationOptions.from_mapping(values, "test")


def rewritten(recording: Recording, folder: Path, **images: np.ndarray) -> Recording:
    """Copy a recording with other images."""
    shutil.copytree(recording.path, folder)
    for name, values in images.items():
        np.save(folder / f"{name}.npy", values)
    return Recording.open(folder)
