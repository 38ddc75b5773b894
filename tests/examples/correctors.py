"""Correctors in TorchScript for the examples."""

from pathlib import Path
from typing import Any

import numpy as np
from correction.export.states import calibration, write

HEIGHT, WIDTH = 5, 7


def save_corrector(path: Path, **changed: Any) -> Path:
    """Write the corrector of a small camera, z depth."""
    write("torchscript", calibration(np.eye(4), **changed), path)
    return path


def frame(seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return depth, uint16 millimetres with one missing return, and amplitude, uint16."""
    random = np.random.default_rng(seed)
    depth = random.integers(400, 3200, (HEIGHT, WIDTH)).astype(np.uint16)
    depth[1, 2] = 0
    return depth, random.integers(5, 1000, (HEIGHT, WIDTH)).astype(np.uint16)
