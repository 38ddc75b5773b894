"""Small sensors and scenes for tests."""

from typing import Any

import torch
from torch import Tensor

from tofcorr.geometry.camera import CameraIntrinsics
from tofcorr.geometry.rays import ray_directions, ray_plane_distance
from tofcorr.sensor.sensor_file import SensorFile

CAMERA = CameraIntrinsics(
    width=16,
    height=12,
    matrix=((20.0, 0.0, 7.2), (0.0, 20.5, 5.9), (0.0, 0.0, 1.0)),
    distortion=(-0.05, 0.01, 0.0, 0.0, 0.0),
)
FREQUENCY = 20.0e6

ERROR = {
    "terms": [
        {"kind": "distance_polynomial", "degree": 3},
        {"kind": "pixel_polynomial", "degree": 2},
        {"kind": "amplitude_polynomial", "variable": "normalised_amplitude", "degree": 2},
    ],
    "coefficients": {
        "distance": {"c0": 0.03, "c1": -0.02, "c2": 0.008, "c3": -0.001},
        "pixel": {"p1": 2e-5, "r0": 5.0, "p2": -1e-5, "c0": 8.0},
        "intensity": {"i3": 4e-6, "i4": -5e-10},
    },
}
NOISE = {"floor_m": 0.001, "shot_m": 0.003, "read_m": 0.001, "reference_amplitude": 800.0}


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


def plane_scene(kind: str = "radial") -> tuple[Tensor, Tensor, Tensor]:
    """Return depth and amplitude of a slanted wall, each (12, 16), and its normal (3,)."""
    rays = ray_directions(CAMERA)
    normal = torch.tensor([0.3, -0.2, -1.0], dtype=torch.float64)
    normal = normal / normal.norm()
    radial = ray_plane_distance(rays, normal, torch.tensor(1.4, dtype=torch.float64))
    amplitude = 1500.0 * -(rays @ normal) / radial**2
    depth = radial * rays[..., 2] if kind == "z" else radial
    return depth, amplitude, normal
