"""What the tests of the import of a board render, and how they look at what it left."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from importing.checkerboard.rendered_board import varied_placements
from optional import present
from running import Said

PLACEMENTS = varied_placements(6)
ERROR = 0.012
FOCAL = ("--focal", "290,288", "--centre", "158.3,121.6")
Run = Callable[..., Said]
LENS = (*FOCAL, "--distortion", "0.06,-0.12,0.0008,-0.0005,0.02")


def read_image(path: Path) -> np.ndarray:
    return present(cv2.imread(str(path), cv2.IMREAD_UNCHANGED))


def report(tmp_path: Path) -> dict[str, Any]:
    return json.loads((tmp_path / "recording" / "import.json").read_text())


def leftovers(tmp_path: Path) -> list[str]:
    return [p.name for p in tmp_path.iterdir() if p.name not in ("images", "other")]
