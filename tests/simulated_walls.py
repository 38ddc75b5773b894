"""Recordings from the simulator for tests of what is estimated: small, quick, truth at hand."""

from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml

from tofcorr.data.recording import Recording
from tofcorr.error_terms.model import ErrorModelOptions
from tofcorr.simulation.options import SimulatorOptions
from tofcorr.simulation.simulator import simulate
from tofcorr.training.dataset import Dataset
from tofcorr.training.domain import covered_domain
from tofcorr.training.fitting import Fit, fit
from tofcorr.training.options import TrainingOptions

CAMERA = {
    "width": 32,
    "height": 25,
    "K": [[45.0, 0.0, 15.9], [0.0, 45.0, 11.8], [0.0, 0.0, 1.0]],
    "distortion": [-0.08, 0.02, 0.0005, -0.0004, 0.0],
}
# Everything that a real sensor does and that EA can describe well: no wiggling, no fixed pattern.
SENSOR = {
    "light": {"electrons_at_1m": 400_000.0, "demodulation_contrast": 0.5},
    "delays": {
        "constant_mm": 18.0,
        "clock_deviation": 0.003,
        "pixel": {"row_line_mm": 6.0, "column_line_mm": -5.0, "bowl_mm": 6.0},
    },
}
WHITE_AND_CHECKERBOARD = (("white", 15), ("checkerboard", 15))
EA = ErrorModelOptions.from_mapping(
    {
        "terms": [
            {"kind": "distance_polynomial", "degree": 3},
            {"kind": "pixel_polynomial", "degree": 2},
            {"kind": "amplitude_polynomial", "variable": "amplitude", "degree": 2},
        ]
    },
    "EA",
)


def simulated_wall(
    folder: Path,
    seed: int = 1,
    shots: tuple[tuple[str, int], ...] = WHITE_AND_CHECKERBOARD,
    sensor: dict[str, Any] | None = None,
    **parts: Any,
) -> Dataset:
    """Simulate a recording; `parts` are sections of the simulator's options."""
    values = {
        "seed": seed,
        "camera": CAMERA,
        "shots": [{"target": target, "poses": poses} for target, poses in shots],
        "sensor": SENSOR if sensor is None else sensor,
        "scene": {"subsamples": 2},
        "hand_eye": {"guess": {"translation_mm": 30.0, "rotation_deg": 5.0}},
        **parts,
    }
    simulate(SimulatorOptions.from_mapping(values, "test"), folder)
    return Dataset((Recording.open(folder),))


def true_hand_eye(dataset: Dataset) -> torch.Tensor:
    """Return the true tool_from_camera (4, 4)."""
    truth = yaml.safe_load((dataset.first.path / "truth" / "truth.yaml").read_text())
    return torch.tensor(truth["tool_from_camera"], dtype=torch.float64)


def fitted(dataset: Dataset, frames: np.ndarray | None = None, **options: Any) -> Fit:
    """Fit EA to some (or all) frames."""
    chosen = np.arange(dataset.num_frames) if frames is None else frames
    training = TrainingOptions(name="EA", model=EA, **options)
    return fit(dataset, chosen, training, covered_domain(dataset, chosen))
