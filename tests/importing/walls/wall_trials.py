"""Distances of a single-pixel sensor beside robot poses.

The trials of Sifferman et al. (2022), `$TOFCORR_REAL_DATA/wall_trials_l3cx`: a line of
`transforms.csv` is a pose, the line of `measurements.csv` with the same number its readings.
"""

from pathlib import Path

import numpy as np
from cameras import camera

MOUNTS = ("P1", "P2")
WALLS = ("R1", "R2", "W1", "W2")
# One pixel at the principal point: its ray is the optical axis.
ONE_PIXEL = camera((1, 1), (1.0, 1.0), (0.0, 0.0))


def read_trial(real_data: Path, wall: str, mount: str) -> tuple[np.ndarray, np.ndarray]:
    """Read poses (N, 4, 4), exact to six digits, and the median distance at each (N,), metres."""
    folder = real_data / "wall_trials_l3cx" / f"L3CX_{wall}_{mount}"
    poses = [_numbers(line) for line in (folder / "transforms.csv").read_text().splitlines()]
    lines = (folder / "measurements.csv").read_text().splitlines()
    readings = [_numbers(line.partition(",")[2]) for line in lines]
    distance = [np.median(one) / 1e3 for one in readings if one]
    return np.array([pose for pose in poses if pose]).reshape(-1, 4, 4), np.array(distance)


def _numbers(line: str) -> list[float]:
    return [float(cell) for cell in line.split(",") if cell.strip()]
