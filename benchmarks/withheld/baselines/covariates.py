"""What a pixel's residual may depend on, and which effects that would speak for."""

from dataclasses import dataclass

import numpy as np

from benchmarks.withheld.fitting import Problem, linearise
from benchmarks.withheld.generator.rigid import Array
from benchmarks.withheld.reading import Data

SPEAKS_FOR: dict[str, tuple[str, ...]] = {
    "distance": ("wiggling", "distance"),
    "amplitude": ("amplitude", "saturation"),
    "brightest": ("saturation", "amplitude"),
    "edge": ("mixed_pixels",),
    "surroundings": ("stray_light",),
    "cosine": ("incidence_angle",),
    "row": ("row_column_pattern", "pixel", "lens", "fixed_pattern"),
    "column": ("row_column_pattern", "pixel", "lens", "fixed_pattern"),
    "pixel": ("fixed_pattern", "row_column_pattern", "pixel"),
    "slope across": ("lens",),
    "slope along": ("lens",),
    "target x": ("target_shape", "target_registration", "multipath"),
    "target y": ("target_shape", "target_registration", "multipath"),
    "tool x": ("robot_kinematics",),
    "tool y": ("robot_kinematics",),
    "tool z": ("robot_kinematics",),
    "speed": ("motion", "timestamp_offset"),
    "time": ("warm_up",),
    "integration time": ("integration_time",),
    "body temperature": ("warm_up", "room_temperature"),
    "room temperature": ("room_temperature", "warm_up"),
    "ambient": ("ambient_light",),
    "ambient share": ("ambient_light",),
}


@dataclass(frozen=True)
class Table:
    """Residuals of the base fit (M,), metres, with covariates (M,) and the frame of each pixel."""

    problem: Problem
    residual: Array
    image: np.ndarray
    pixel: np.ndarray
    covariates: dict[str, Array]

    @property
    def standardised(self) -> Array:
        """Residuals in units of their spread, which grows as the amplitude falls."""
        scaled = self.residual * np.sqrt(self.problem.weight)
        return scaled / scaled.std()


def tabulate(data: Data) -> Table:
    """Fit the base and gather the covariates of every used pixel."""
    problem = linearise(data)
    image, row, column = np.nonzero(data.valid)
    pixel = row * data.depth.shape[2] + column
    camera = data.world_from_tool @ problem.tool_from_camera
    point = _points(camera, data, image, row, column, problem.distance)
    across, along = _in_plane(data.normal[0])
    ray = np.einsum("nij,nj->ni", camera[image, :3, :3], data.rays[row, column])
    values: dict[str, Array] = {
        "distance": problem.distance,
        "cosine": problem.cosine,
        "row": row.astype(float),
        "column": column.astype(float),
        "slope across": ray @ across / problem.cosine,
        "slope along": ray @ along / problem.cosine,
        "target x": point @ across,
        "target y": point @ along,
        "time": data.columns["timestamp_s"][image],
        "speed": _speed(data, camera)[image],
    }
    values |= {f"tool {axis}": data.world_from_tool[image, k, 3] for k, axis in enumerate("xyz")}
    residual = problem.residual
    values["pixel"] = _pixel_mean(residual, pixel)
    values |= _amplitudes(data, image, row, column) | _logged(data, image, problem.distance)
    return Table(problem, residual, image, pixel, values)


def _amplitudes(
    data: Data, image: np.ndarray, row: np.ndarray, column: np.ndarray
) -> dict[str, Array]:
    if data.amplitude is None:
        return {}
    logarithm = np.log(np.maximum(data.amplitude, 1e-6))
    edge = np.hypot(np.gradient(logarithm, axis=1), np.gradient(logarithm, axis=2))
    mean = data.amplitude.mean((1, 2), keepdims=True)
    here = (image, row, column)
    bright = np.maximum(data.amplitude - np.quantile(data.amplitude, 0.97), 0.0)
    return {
        "amplitude": logarithm[here],
        "brightest": bright[here],
        "edge": edge[here],
        "surroundings": (mean / data.amplitude)[here],
    }


def _logged(data: Data, image: np.ndarray, distance: Array) -> dict[str, Array]:
    names = {
        "integration_time_us": "integration time",
        "body_temperature_c": "body temperature",
        "room_temperature_c": "room temperature",
        "ambient": "ambient",
    }
    logged = {new: data.columns[old][image] for old, new in names.items() if old in data.columns}
    if "ambient" in logged:
        logged["ambient share"] = logged["ambient"] * distance**2
    return logged


def _pixel_mean(residual: Array, pixel: np.ndarray) -> Array:
    """Mean residual of the same pixel in all other frames."""
    total, count = np.bincount(pixel, residual), np.bincount(pixel)
    return (total[pixel] - residual) / np.maximum(count[pixel] - 1, 1)


def _points(
    camera: Array,
    data: Data,
    image: np.ndarray,
    row: np.ndarray,
    column: np.ndarray,
    distance: Array,
) -> Array:
    turned = np.einsum("nij,nj->ni", camera[image, :3, :3], data.rays[row, column])
    return camera[image, :3, 3] + distance[:, None] * turned


def _in_plane(normal: Array) -> tuple[Array, Array]:
    helper = np.eye(3)[np.argmin(np.abs(normal))]
    across = np.cross(normal, helper)
    across = across / np.linalg.norm(across)
    return across.astype(float), np.cross(normal, across).astype(float)


def _speed(data: Data, camera: Array) -> Array:
    """Speed from the target (N,) between frames less than a second apart, m/s; else zero."""
    height = (camera[:, :3, 3] * data.normal).sum(-1) + data.offset
    time = data.columns["timestamp_s"]
    gaps, steps = np.diff(time), np.diff(height)
    rate = np.where(gaps < 1.0, steps / np.maximum(gaps, 1e-3), np.nan)
    both = np.stack([np.append(rate, np.nan), np.insert(rate, 0, np.nan)])
    known = np.isfinite(both)
    return np.where(known, both, 0.0).sum(0) / np.maximum(known.sum(0), 1)
