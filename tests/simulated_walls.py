"""Recordings from the simulator for tests of what is estimated: small, quick, truth at hand."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml
from optional import present
from torch import Generator

from tofcorr.data.recording import Recording
from tofcorr.data.writing import RecordingWriter
from tofcorr.fit.fitting import fit
from tofcorr.fit.problem import Fit
from tofcorr.geometry import se3
from tofcorr.options import resolve_options
from tofcorr.pixels.dataset import Dataset
from tofcorr.pixels.lattice import covered_domain
from tofcorr.pixels.sample import usable_pixels
from tofcorr.simulation.options import SimulatorOptions
from tofcorr.simulation.robot import draw_plan
from tofcorr.simulation.simulator import append_frame, simulate, take_frames
from tofcorr.training.advice import advise, draw_pool
from tofcorr.training.calibration import TrainingOptions

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
# More light, and a converter that it does not fill.
QUIET = {
    "light": {"electrons_at_1m": 2.5e6, "demodulation_contrast": 0.4},
    "readout": {"electrons_per_count": 250.0, "converter_bits": 16},
}
WHITE_AND_CHECKERBOARD = (("white", 15), ("checkerboard", 15))
EA = resolve_options(TrainingOptions, "ea").model


def simulated_wall(
    folder: Path,
    seed: int = 1,
    shots: tuple[tuple[str, int], ...] = WHITE_AND_CHECKERBOARD,
    sensor: dict[str, Any] | None = None,
    **parts: Any,
) -> Dataset:
    """Simulate a recording; `parts` are sections of the simulator's options."""
    simulate(wall_options(seed, shots, sensor, **parts), folder)
    return Dataset((Recording.open(folder),))


def wall_options(
    seed: int,
    shots: tuple[tuple[str, int], ...] = WHITE_AND_CHECKERBOARD,
    sensor: dict[str, Any] | None = None,
    **parts: Any,
) -> SimulatorOptions:
    """Return the simulator's options; `parts` are sections of them."""
    values = {
        "seed": seed,
        "camera": CAMERA,
        "shots": [{"target": target, "poses": poses} for target, poses in shots],
        "sensor": SENSOR if sensor is None else sensor,
        "scene": {"subsamples": 2},
        "hand_eye": {"guess": {"translation_mm": 30.0, "rotation_deg": 5.0}},
        **parts,
    }
    return SimulatorOptions.from_mapping(values, "test")


def true_hand_eye(dataset: Dataset) -> torch.Tensor:
    """Return the true tool_from_camera (4, 4)."""
    truth = yaml.safe_load((dataset.first.path / "truth" / "truth.yaml").read_text())
    return torch.tensor(truth["tool_from_camera"], dtype=torch.float64)


def fitted(dataset: Dataset, frames: np.ndarray | None = None, **options: Any) -> Fit:
    """Fit EA to some (or all) frames."""
    chosen = np.arange(dataset.num_frames) if frames is None else frames
    training = TrainingOptions.from_mapping({"name": "EA", "model": EA, **options}, "test")
    dataset = usable_pixels(dataset, training, robust=training.weights.robust != "none")
    return fit(dataset, chosen, training, covered_domain(dataset, chosen))


def followed(folder: Path, seed: int, robot: dict[str, Any]) -> dict[str, float]:
    """Add five poses to a recording of 30, advised ones or random ones of the same pool.

    Returns:
        The worst sigma (metres or radians) before, and after a fit with either five.
    """
    first = simulated_wall(folder / "first", seed, robot=robot)
    before = fitted(first)
    frames = np.arange(first.num_frames)
    random = np.random.default_rng(seed)
    pool = present(draw_pool(first, frames, before, random))
    advised, _ = advise(first, pool, before)
    at_random = random.choice(len(pool.target), len(advised), replace=False).tolist()
    worst = {"before": before.observability.directions[0].sigma}
    generator = Generator().manual_seed(seed)
    for name, chosen in (("advised", advised), ("random", at_random)):
        targets = [pool.target[k] for k in chosen]
        more = taken(folder / name, seed, pool.world_from_tool[chosen], targets, generator)
        both = Dataset((first.first, more.first))
        worst[name] = fitted(both).observability.directions[0].sigma
    return worst


def taken(
    folder: Path, seed: int, world_from_tool: torch.Tensor, targets: list[str], generator: Generator
) -> Dataset:
    """Simulate a recording at given poses, with the robot's repeatability and sensor noise."""
    shots = tuple((target, 1) for target in targets)
    options = wall_options(seed, shots, conditions={"recorded": ()})
    plan = draw_plan(options, Generator().manual_seed(seed))
    robot = options.robot
    scale = torch.tensor([robot.repeatability_mm] * 3 + [robot.repeatability_mrad] * 3) / 1e3
    slips = scale.double() * torch.randn(len(targets), 6, generator=generator, dtype=torch.float64)
    times = torch.arange(len(targets), dtype=torch.float64)
    facts = replace(plan[-1].facts, timestamp=times, world_from_tool=world_from_tool)
    reached = world_from_tool @ se3.exp(slips)
    frames = [
        replace(frame, facts=facts.at(slice(k + 1)), target=targets[k], world_from_tool=reached[k])
        for k, frame in enumerate(plan)
    ]
    with RecordingWriter(
        folder,
        camera=options.camera.intrinsics(),
        depth_kind="radial",
        modulation_frequency=options.sensor.modulation_frequency_hz,
    ) as writer:
        for state in take_frames(options, frames, generator):
            append_frame(writer, state, options)
    return Dataset((Recording.open(folder),))
