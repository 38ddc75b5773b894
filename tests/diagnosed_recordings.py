"""Small simulated recordings for the tests of effects and diagnosis."""

import copy
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from tofcorr.data.recording import Recording
from tofcorr.diagnosis.sums.observations import effect_inputs, observe
from tofcorr.simulation.effects.base import EffectInputs
from tofcorr.simulation.options import SimulatorOptions
from tofcorr.simulation.simulator import simulate

PLAIN: dict[str, Any] = {
    "camera": {
        "width": 32,
        "height": 24,
        "K": [[45.0, 0.0, 15.7], [0.0, 45.0, 11.6], [0.0, 0.0, 1.0]],
        "distortion": [-0.08, 0.02, 0.0005, -0.0004, 0.0],
    },
    "shots": [{"target": "white", "poses": 20}, {"target": "checkerboard", "poses": 30}],
    "scene": {
        "targets": {
            "white": {"pattern": "uniform", "reflectivity": 0.8},
            "checkerboard": {
                "pattern": "checkerboard",
                "square_mm": 150.0,
                "reflectivity_dark": 0.15,
                "reflectivity_bright": 0.8,
            },
        }
    },
    "sensor": {
        "modulation_frequency_hz": 20e6,
        "light": {"electrons_at_1m": 1_600_000.0, "demodulation_contrast": 0.5},
        "delays": {
            "constant_mm": 18.0,
            "clock_deviation": 0.003,
            "pixel": {"bowl_mm": 3.0},
            "amplitude": {"law": "power", "scale_mm": 0.5, "electrons": 50000.0, "exponent": 1.0},
        },
    },
    "hand_eye": {"guess": {"translation_mm": 30.0, "rotation_deg": 5.0}},
    "conditions": {
        "frame_interval_s": 20.0,
        "integration_time_us": [250.0, 500.0, 1000.0],
        "ambient_counts": [0.0, 400.0],
        "room_drift_c": 2.0,
    },
}
"""A camera whose own errors the base model describes."""

MOVING = {"robot": {"motion": "continuous"}, "conditions": {"frame_interval_s": 0.3}}
"""A robot that never stops."""

STILL: dict[str, Any] = {
    "shots": [{"target": "white", "poses": 12}],
    "conditions": {"integration_time_us": [500.0]},
    "robot": {"repeatability_mm": 0.0, "repeatability_mrad": 0.0},
}
"""A white wall seen at one exposure from poses that are as stated."""

TIME: dict[str, Any] = {"name": "integration_time", "log_1": 0.006}
"""An effect of a few millimetres."""


def simulator(
    seed: int, effects: Sequence[Mapping[str, Any]] = (), changes: Mapping[str, Any] | None = None
) -> SimulatorOptions:
    """Return the plain simulator with another seed, effects and changed keys."""
    values = _merged(copy.deepcopy(PLAIN), changes or {})
    return SimulatorOptions.from_mapping(values | {"seed": seed, "effects": list(effects)}, "test")


def recorded(
    folder: Path,
    seed: int,
    effects: Sequence[Mapping[str, Any]] = (),
    changes: Mapping[str, Any] | None = None,
    *,
    noise: bool = True,
) -> Recording:
    """Simulate a recording."""
    simulate(simulator(seed, effects, changes), folder, noise=noise)
    return Recording.open(folder)


def altered(
    recording: Recording, change: Callable[[np.ndarray], np.ndarray], name: str = "depth"
) -> Recording:
    """Change images of a recording, (N, H, W), and open it again."""
    path = recording.path / f"{name}.npy"
    np.save(path, change(np.load(path)).astype(np.float32))
    return Recording.open(recording.path)


def true_inputs(recording: Recording, own: SimulatorOptions) -> EffectInputs:
    """Return what effects look at, with the true hand-eye transform."""
    observations = observe(recording, 10_000_000)
    return effect_inputs(observations, own.hand_eye.tool_from_camera())


def measured(recording: Recording) -> torch.Tensor:
    """Return all radial distances, flattened frame by frame, metres."""
    return observe(recording, 10_000_000).measured


def _merged(values: dict[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    for key, change in changes.items():
        if isinstance(change, Mapping) and change and isinstance(values.get(key), dict):
            values[key] = _merged(values[key], change)
        else:
            values[key] = change
    return values
