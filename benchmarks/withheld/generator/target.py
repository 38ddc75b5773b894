"""The target: nested squares of several reflectivities on a board, or a plain wall."""

from dataclasses import dataclass

import numpy as np

from benchmarks.withheld.generator.rigid import Array

BOARD_HALF = (1.05, 0.85)  # metres
PANEL_HALF = (1.3, 1.1)  # the white target; pixels that see beyond either look at a wall behind it
WALL_BEHIND = 0.6  # metres
WHITE = 0.82


@dataclass(frozen=True)
class Target:
    """A board whose squares hold a smaller square each; some squares are plain."""

    square: float  # metres
    origin: tuple[float, float]
    dark: float
    bright: float
    inner_scale: (
        Array  # (7, 7): reflectivity of the inner square relative to its square; 1 for a plain one
    )
    checkerboard: np.ndarray  # (N,) bool: this frame looks at the board, else at a white wall

    def reflectivity(self, x: Array, y: Array) -> Array:
        """Reflectivity (N, H, W) at the target's coordinates, metres."""
        i, j, fx, fy = self._cell(x, y)
        outer = np.where((i + j) % 2, self.dark, self.bright)
        inside = np.maximum(np.abs(fx - 0.5), np.abs(fy - 0.5)) < 0.25
        board = outer * np.where(inside, self.inner_scale[i % 7, j % 7], 1.0)
        return np.where(self.checkerboard[:, None, None], board, WHITE)

    def beyond(self, x: Array, y: Array, rim: float) -> np.ndarray:
        """Whether coordinates (N, H, W) lie off the target or within `rim` metres of its edge."""
        board = self.checkerboard[:, None, None]
        half_x, half_y = (
            np.where(board, *halves) for halves in zip(BOARD_HALF, PANEL_HALF, strict=True)
        )
        return (np.abs(x) > half_x - rim) | (np.abs(y) > half_y - rim)

    def edge_distance(self, x: Array, y: Array) -> Array:
        """Distance (N, H, W), metres, to the nearest change of reflectivity; infinite on white."""
        i, j, fx, fy = self._cell(x, y)
        outer = np.minimum(0.5 - np.abs(fx - 0.5), 0.5 - np.abs(fy - 0.5))
        nested = np.abs(np.maximum(np.abs(fx - 0.5), np.abs(fy - 0.5)) - 0.25)
        nested = np.where(self.inner_scale[i % 7, j % 7] == 1.0, np.inf, nested)
        distance = self.square * np.minimum(outer, nested)
        return np.where(self.checkerboard[:, None, None], distance, np.inf)

    def _cell(self, x: Array, y: Array) -> tuple[np.ndarray, np.ndarray, Array, Array]:
        u, v = (x - self.origin[0]) / self.square, (y - self.origin[1]) / self.square
        i, j = np.floor(u), np.floor(v)
        return i.astype(int), j.astype(int), u - i, v - j


def draw_target(rng: np.random.Generator, pose_id: np.ndarray, targets: str) -> Target:
    """Draw a board and which frames look at it (65 % of the stations, or none)."""
    share = 0.0 if targets == "white" else 0.65
    inner = np.where(rng.uniform(size=(7, 7)) < 0.5, 1.0, rng.uniform(0.5, 1.15, (7, 7)))
    return Target(
        square=rng.uniform(0.13, 0.18),
        origin=(rng.uniform(0, 0.1), rng.uniform(0, 0.1)),
        dark=rng.uniform(0.10, 0.16),
        bright=rng.uniform(0.72, 0.85),
        inner_scale=inner,
        checkerboard=(rng.uniform(size=pose_id[-1] + 1) < share)[pose_id],
    )
