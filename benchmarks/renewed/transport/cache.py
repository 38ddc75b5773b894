"""Rendered light is costly and depends on its scene and seed alone: it is kept in a folder.

The folder is `$TOFCORR_RENDERED`, or one in the system's folder for temporary files. It is never
part of the repository, and may be removed at any time.
"""

import hashlib
import os
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np


def cached(key: str, make: Callable[[], np.ndarray]) -> np.ndarray:
    """The array that was made for a key before, or is made now."""
    folder = Path(os.environ.get("TOFCORR_RENDERED", Path(tempfile.gettempdir()) / "rendered"))
    file = folder / f"{hashlib.sha256(key.encode()).hexdigest()[:24]}.npy"
    if file.exists():
        return np.load(file)
    array = make()
    folder.mkdir(parents=True, exist_ok=True)
    part = file.with_suffix(f".{os.getpid()}.part.npy")
    np.save(part, array)
    part.rename(file)
    return array
