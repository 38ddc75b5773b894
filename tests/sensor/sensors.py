"""Small sensors and scenes for tests."""

from typing import Any

import torch
from cameras import camera
from synthetic_scene import EB
from torch import Tensor

from tofcorr.conditions import condition
from tofcorr.geometry.rays import ray_directions, ray_plane_distance
from tofcorr.sensor.model import SensorModel
from tofcorr.sensor.sensor_file import SensorFile

CAMERA = camera((16, 12), (20.0, 20.5), (7.2, 5.9), -0.05, 0.01, 0.0, 0.0, 0.0)
FREQUENCY = 20.0e6

ERROR = EB | {
    "coefficients": {
        "distance": {"c0": 0.03, "c1": -0.02, "c2": 0.008, "c3": -0.001},
        "pixel": {"p1": 2e-5, "r0": 5.0, "p2": -1e-5, "c0": 8.0},
        "intensity": {"i3": 4e-6, "i4": -5e-10},
    }
}
NOISE = {"floor_m": 0.001, "shot_m": 0.003, "read_m": 0.001, "reference_amplitude": 800.0}


EFFECTS: dict[str, dict[str, Any]] = {
    "distance": {"legendre_1": 0.02, "legendre_5": -0.01},
    "pixel": {"x1_y0": 0.004, "x2_y2": 0.003, "growth_r2": 0.002},
    "amplitude": {"low_counts": 50.0, "high_counts": 2000.0, "log_2": 0.004, "square": 0.003},
    "wiggling": {"sin_4": 0.006, "cos_8": -0.002},
    "integration_time": {"reference_us": 400.0, "degree": 1, "log_1": -0.006},
    "warm_up": {"rise_200s": 0.008},
    "room_temperature": {"per_degree": 0.003},
    "ambient_light": {"share": 0.01, "false_sine": 0.004},
    "incidence_angle": {"secant": 0.03, "square": 0.02},
    "mixed_pixels": {"share_0.6px": 0.3},
    "stray_light": {"share_0.12": 0.1},
    "saturation": {"full_counts": 3000.0, "soft": 0.2, "knee_0.5": 0.3},
    "fixed_pattern": {"height": 12, "width": 16, "rms_m": 0.004, "seed": 3},
    "row_column_pattern": {"height": 12, "width": 16, "row_rms_m": 0.002, "column_rms_m": 0.001},
    "lens": {"focal_x": 0.01, "centre_y_px": 0.4, "radial_2": 0.02},
}
IN_SI = {"timestamp": 90.0, "integration_time": 800e-6, "room_temperature": 25.0, "ambient": 300.0}
KNOWN = {condition(name): value for name, value in IN_SI.items()}
CONDITIONS: dict[str, float] = {one.column: one.in_file(value) for one, value in KNOWN.items()}


def entries(*names: str) -> list[dict[str, Any]]:
    """Return effects as in a `sensor.yaml`."""
    return [{"name": name, **EFFECTS[name]} for name in names]


def sensor_values(**changes: Any) -> dict[str, Any]:
    """Return the content of a `sensor.yaml`, with changes."""
    return {
        "format": "tofcorr-sensor",
        "version": 1,
        "camera": CAMERA.section(),
        "depth_kind": "radial",
        "modulation_frequency_hz": FREQUENCY,
        "validity": {
            "radial_distance_m": [0.4, 3.0],
            "amplitude": [50.0, 6000.0],
            "normalised_amplitude": [50.0, 6000.0],
        },
    } | changes


def sensor_file(**changes: Any) -> SensorFile:
    """Return a checked sensor file."""
    return SensorFile.from_mapping(sensor_values(**changes), "the test")


def sensor(dtype: torch.dtype = torch.float64, **changes: Any) -> SensorModel:
    """Return the model of a sensor file."""
    return SensorModel(sensor_file(**changes), dtype)


def plane_scene(kind: str = "radial") -> tuple[Tensor, Tensor, Tensor]:
    """Return depth and amplitude of a slanted wall, each (12, 16), and its normal (3,)."""
    rays = ray_directions(CAMERA)
    normal = torch.tensor([0.3, -0.2, -1.0], dtype=torch.float64)
    normal = normal / normal.norm()
    radial = ray_plane_distance(rays, normal, torch.tensor(1.4, dtype=torch.float64))
    amplitude = 1500.0 * -(rays @ normal) / radial**2
    depth = radial * rays[..., 2] if kind == "z" else radial
    return depth, amplitude, normal
