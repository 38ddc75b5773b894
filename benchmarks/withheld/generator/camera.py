"""The camera: intrinsics, viewing rays, modulation."""

from dataclasses import dataclass

import numpy as np

from benchmarks.withheld.generator.rigid import Array

SPEED_OF_LIGHT = 299_792_458.0  # m/s


@dataclass(frozen=True)
class Camera:
    """A camera with OpenCV's five-coefficient lens model; `sensitivity` is in electrons."""

    width: int
    height: int
    focal: tuple[float, float]
    centre: tuple[float, float]
    distortion: tuple[float, float, float, float, float]
    modulation_frequency: float
    sensitivity: float  # amplitude of a white target at 1 m, at nominal exposure, electrons
    counts_per_electron: float

    @property
    def matrix(self) -> list[list[float]]:
        """The 3x3 intrinsic matrix as nested lists."""
        return [
            [self.focal[0], 0.0, self.centre[0]],
            [0.0, self.focal[1], self.centre[1]],
            [0.0, 0.0, 1.0],
        ]

    @property
    def unambiguous_range(self) -> float:
        """Distance at which the phase has gone once round, metres."""
        return SPEED_OF_LIGHT / (2 * self.modulation_frequency)

    def slopes(self) -> tuple[Array, Array]:
        """Undistorted x/z and y/z (H, W) of every pixel, by Newton's method on the lens model."""
        column, row = np.meshgrid(
            np.arange(self.width, dtype=float), np.arange(self.height, dtype=float)
        )
        target = np.stack(
            [(column - self.centre[0]) / self.focal[0], (row - self.centre[1]) / self.focal[1]]
        )
        point, step = target.copy(), 1e-6
        for _ in range(8):
            here = self._distort(point)
            along_x = (self._distort(point + np.array([step, 0.0])[:, None, None]) - here) / step
            along_y = (self._distort(point + np.array([0.0, step])[:, None, None]) - here) / step
            miss = target - here
            determinant = along_x[0] * along_y[1] - along_x[1] * along_y[0]
            point[0] += (miss[0] * along_y[1] - miss[1] * along_y[0]) / determinant
            point[1] += (miss[1] * along_x[0] - miss[0] * along_x[1]) / determinant
        return point[0], point[1]

    def rays(self) -> Array:
        """Unit viewing directions (H, W, 3) in the camera frame."""
        return directions(*self.slopes())

    def _distort(self, point: Array) -> Array:
        x, y = point
        k1, k2, p1, p2, k3 = self.distortion
        square = x * x + y * y
        radial = 1 + square * (k1 + square * (k2 + square * k3))
        return np.stack(
            [
                x * radial + 2 * p1 * x * y + p2 * (square + 2 * x * x),
                y * radial + p1 * (square + 2 * y * y) + 2 * p2 * x * y,
            ]
        )


def directions(x: Array, y: Array) -> Array:
    """Unit vectors (H, W, 3) of slopes x/z and y/z."""
    rays = np.stack([x, y, np.ones_like(x)], axis=-1)
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)


def draw_camera(rng: np.random.Generator) -> Camera:
    """Draw one of two models with its unit-to-unit spread."""
    width, height, focal, frequency, barrel = [
        (56, 40, 70.0, 24e6, -0.11),
        (60, 48, 66.0, 30e6, 0.06),
    ][rng.integers(2)]
    focal *= rng.uniform(0.97, 1.03)
    return Camera(
        width=width,
        height=height,
        focal=(focal, focal * rng.uniform(0.998, 1.002)),
        centre=((width - 1) / 2 + rng.normal(0, 1.0), (height - 1) / 2 + rng.normal(0, 1.0)),
        distortion=(barrel, 0.03 * np.sign(-barrel), rng.normal(0, 4e-4), rng.normal(0, 4e-4), 0.0),
        modulation_frequency=frequency,
        sensitivity=float(1.6e5 * (24e6 / frequency) ** 2),
        counts_per_electron=rng.uniform(0.02, 0.05),
    )
