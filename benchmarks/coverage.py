"""Do the intervals hold what they promise? Coverage of the hand-eye's over simulated recordings.

    python -m benchmarks.coverage --recordings 200 --seed 0 --out coverage.json

Every recording has its own poses, robot slips and noise; the truth comes from the simulator. Each
interval is about one axis; in a study of R recordings its coverage has a standard error of
sqrt(0.95 * 0.05 / R).
"""

import json
import tempfile
from pathlib import Path

import click
import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from benchmarks.timing import write
from tofcorr.data.recording import Recording
from tofcorr.fit.fitting import Fit, fit
from tofcorr.geometry import se3
from tofcorr.options import load_options
from tofcorr.pixels.dataset import Dataset, covered_domain
from tofcorr.simulation.options import SimulatorOptions
from tofcorr.simulation.simulator import simulate
from tofcorr.training.calibration import TrainingOptions
from tofcorr.training.report import hand_eye_intervals

NAMES = [f"{kind}_{axis}" for kind in "tw" for axis in "xyz"]


def fitted(recording: Path, options: TrainingOptions) -> Fit:
    """Fit all frames of a recording."""
    data = Dataset((Recording.open(recording),))
    frames = np.arange(data.num_frames)
    return fit(data, frames, options, covered_domain(data, frames))


def hand_eye_error(true: Tensor, found: Tensor) -> Tensor:
    """Return place and turn (2, 3) of a hand-eye transform off the true one.

    In camera axes, metres and radians.
    """
    turn = se3.log(se3.assemble(true[:3, :3].T @ found[:3, :3], torch.zeros(3).double()))[3:]
    return torch.stack([true[:3, :3].T @ (found - true)[:3, 3], turn])


def one_recording(
    simulator: SimulatorOptions, training: TrainingOptions, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """Simulate and fit one recording.

    Returns:
        Error and interval's half-width of translation (metres) and rotation (radians) about the
        tool's axes, each (6,).
    """
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "recording"
        simulate(simulator, path, torch.Generator().manual_seed(seed))
        result = fitted(path, training)
    truth = simulator.hand_eye.tool_from_camera()
    error = hand_eye_error(truth, result.solution.parameters.tool_from_camera)
    about_tool = (error @ truth[:3, :3].T).flatten()
    return about_tool.numpy(), torch.cat(tuple(hand_eye_intervals(result))).numpy()


def study(
    simulator: SimulatorOptions, training: TrainingOptions, recordings: int, seed: int
) -> dict[str, object]:
    """Return coverage, bias and spread of the hand-eye transform over simulated recordings."""
    seeds = [seed * 1_000_003 + k for k in range(recordings)]
    results = [one_recording(simulator, training, one) for one in tqdm(seeds, leave=False)]
    error, half = (np.stack(one) for one in zip(*results, strict=True))
    covered = (np.abs(error) <= half).mean(axis=0)
    scale = np.array([1e3] * 3 + [np.degrees(1.0)] * 3)
    return {
        "recordings": recordings,
        "seed": seed,
        "model": training.name,
        "frames": sum(shot.poses for shot in simulator.shots),
        "coverage": {
            "translation": float(covered[:3].mean()),
            "rotation": float(covered[3:].mean()),
            "each": dict(zip(NAMES, covered.tolist(), strict=True)),
        },
        "mean_error_mm_deg": (error.mean(axis=0) * scale).tolist(),
        "spread_mm_deg": (error.std(axis=0, ddof=1) * scale).tolist(),
        "median_half_width_mm_deg": (np.median(half, axis=0) * scale).tolist(),
    }


@click.command()
@click.option("--simulate", "simulator", default="configs/simulate/coverage.yaml")
@click.option("--config", default="configs/train/ea.yaml", help="The model fitted.")
@click.option("--recordings", default=200)
@click.option("--seed", default=0)
@click.option("--out", type=click.Path(path_type=Path), help="JSON file; printed as well.")
def main(simulator: str, config: str, recordings: int, seed: int, out: Path | None) -> None:
    """Measure the coverage of the hand-eye's 95 % intervals."""
    torch.set_num_threads(1)
    camera, model = load_options(SimulatorOptions, simulator), load_options(TrainingOptions, config)
    result = study(camera, model, recordings, seed)
    click.echo(json.dumps(result, indent=1))
    write(result, out)


if __name__ == "__main__":
    main()
