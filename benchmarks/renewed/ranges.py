"""The ranges from which every design is drawn: the one place where they are stated in code.

The README of this package shows them as one table, and a test compares the two. They were written
down before the program had seen a recording, and are not moved because of what it says.
"""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any
from unittest.mock import patch

import numpy as np


@dataclass(frozen=True)
class Range:
    """Numbers between two limits, evenly or evenly in their logarithm."""

    low: float
    high: float
    log: bool = False

    def draw(self, rng: np.random.Generator) -> float:
        """One number."""
        if self.log:
            return float(np.exp(rng.uniform(np.log(self.low), np.log(self.high))))
        return float(rng.uniform(self.low, self.high))


def draw_of(choices: Mapping[Any, float], rng: np.random.Generator) -> Any:  # noqa: ANN401
    """One of the keys, which have these probabilities."""
    keys = list(choices)
    weights = np.array([choices[key] for key in keys])
    return keys[rng.choice(len(keys), p=weights / weights.sum())]


SIZES_MM = Range(2.0, 16.0, log=True)  # RMS of an effect over the pixels on the target
IMAGES = {  # width, height
    (32, 24): 0.22,
    (48, 36): 0.22,
    (64, 48): 0.24,
    (80, 60): 0.12,
    (112, 84): 0.09,
    (160, 120): 0.06,
    (224, 172): 0.03,
    (512, 424): 0.02,
}
FRAMES = {
    15: 0.06,
    20: 0.06,
    30: 0.14,
    45: 0.16,
    60: 0.26,
    90: 0.14,
    120: 0.11,
    200: 0.05,
    300: 0.02,
}
MOST_PIXELS = 1.2e6  # in a recording: fewer frames where the image is large, 15 at least
NEAR_M = Range(0.2, 2.5, log=True)  # nearest station
FARTHEST_TIMES = Range(1.8, 4.0)  # farthest over nearest station
FARTHEST_M = 8.0
TILT_DEG = Range(12.0, 38.0)  # largest tilt about either axis
FOCAL_WIDTHS = Range(0.75, 1.3)  # focal length over the image's width
BARREL = Range(-0.12, 0.08)  # k1
FREQUENCIES_MHZ = {  # the last one is what recording.yaml states
    (20.0,): 0.2,
    (31.0,): 0.15,
    (60.0,): 0.15,
    (100.0,): 0.05,
    (18.0, 60.0): 0.15,
    (24.0, 100.0): 0.1,
    (16.0, 80.0, 120.0): 0.2,
}
NOISE_MM = Range(0.8, 6.0, log=True)  # one frame, white target, middle distance, before filters
OUTDOOR = 0.15  # share of recordings under sunlight
SUN = Range(5.0, 25.0, log=True)  # its electrons over those of the signal at the middle distance
TAILS = {np.inf: 0.8, 6.0: 0.2}  # degrees of freedom of the noise
SPATIAL_FILTER = {"none": 0.55, "mean of 3x3": 0.25, "gauss of 1.2 pixels": 0.2}
TEMPORAL_FILTER = {0.0: 0.7, 0.4: 0.15, 0.7: 0.15}  # share kept of the frame before, within a pose
ROUNDING_MM = {0.0: 0.5, 0.25: 0.15, 1.0: 0.3, 2.0: 0.05}
ROBOT_MM = Range(0.1, 2.0, log=True)  # each axis; as many mrad
ON_THE_MOVE = 0.12  # share of recordings taken without stopping
REPEATED = {0.0: 0.3, 0.1: 0.3, 0.2: 0.25, 0.35: 0.15}  # share of stations seen several times
REPEATS = {2: 0.2, 3: 0.4, 5: 0.4}
SCENES = {"wall": 0.45, "floor": 0.2, "corner": 0.1, "board": 0.25}
TARGETS = {"white": 0.2, "checkerboard": 0.4, "both": 0.2, "grey": 0.1, "texture": 0.1}
MASKS = {"all that is seen": 0.3, "exact, two pixels less": 0.25, "RANSAC": 0.45}
RANSAC_SHARE = Range(0.012, 0.03)  # its threshold over the middle distance
LEAST_RANSAC_MM = 8.0  # and at least so much, and three times the scatter
EXPOSURES = {"random": 0.55, "constant": 0.25, "automatic": 0.1, "bracketed": 0.1}
LOGGED = 0.75  # probability that a column that nothing needs is there
ROOM_K = Range(1.0, 8.0)  # swing of the room's temperature
DEPTH_KIND = {"radial": 0.5, "z": 0.5}
GUESS = (0.012, 0.025)  # of the hand-eye guess: metres, radians, each axis

PLAIN: dict[str, Any] = {  # a plain laboratory, for checks that vary one thing
    "IMAGES": {(48, 36): 1.0},
    "FRAMES": {60: 1.0},
    "MOST_PIXELS": 2e6,
    "NEAR_M": Range(0.5, 0.5),
    "FARTHEST_TIMES": Range(4.0, 4.0),
    "FREQUENCIES_MHZ": {(20.0,): 1.0},
    "NOISE_MM": Range(3.0, 3.0),
    "OUTDOOR": 0.0,
    "TAILS": {np.inf: 1.0},
    "SPATIAL_FILTER": {"none": 1.0},
    "TEMPORAL_FILTER": {0.0: 1.0},
    "ROUNDING_MM": {0.0: 1.0},
    "ROBOT_MM": Range(0.3, 0.3),
    "ON_THE_MOVE": 0.0,
    "REPEATED": {0.1: 1.0},
    "SCENES": {"wall": 1.0},
    "TARGETS": {"both": 1.0},
    "MASKS": {"exact, two pixels less": 1.0},
    "EXPOSURES": {"random": 1.0},
    "LOGGED": 1.0,
}


@contextmanager
def drawn_from(**others: Any) -> Iterator[None]:  # noqa: ANN401 - ranges of any kind
    """Draw worlds from other ranges while this lasts."""
    with patch.dict(globals(), others):
        yield
