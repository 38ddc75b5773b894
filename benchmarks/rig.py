"""Do the intervals of cameras calibrated together hold, and is that better than each alone?

    python -m benchmarks.rig --seed S --count 100

Each case has two cameras with errors of their own on one robot of 20 to 40 stops, before one wall
whose place is unknown. Their hand-eye transforms differ at random. EA is fitted to both together,
and to each alone. Compared is the transform from one camera to the other.
"""

import tempfile
from pathlib import Path
from typing import Any

import click
import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from benchmarks.sealed.scores import share, table
from benchmarks.wrong_recordings.clean import drawn_simulator
from tofcorr.data.recording import Recording
from tofcorr.estimation.robust import student_quantile
from tofcorr.fit.fitting import fit
from tofcorr.fit.joint import fit_together
from tofcorr.fit.problem import Problem
from tofcorr.geometry import se3
from tofcorr.options import resolve_options
from tofcorr.pixels.dataset import Dataset
from tofcorr.pixels.lattice import covered_domain, lattice_of
from tofcorr.simulation.options import SimulatorOptions
from tofcorr.simulation.simulator import simulate
from tofcorr.training.calibration import TrainingOptions

AXES = ("x", "y", "z", "turn x", "turn y", "turn z")


def drawn_camera(generator: np.random.Generator) -> dict[str, Any]:
    """Return the simulator's options of a camera and its robot."""
    values = drawn_simulator(generator)
    values["shots"] = [{"target": "white", "poses": int(generator.integers(20, 41))}]
    values["sensor"] |= {"light": {"electrons_at_1m": 2.5e6}, "harmonics": []}
    values["sensor"]["readout"] = {"electrons_per_count": 250.0, "converter_bits": 16}
    values["hand_eye"] |= {
        "translation_mm": generator.uniform(-150, 150, 3).tolist(),
        "rotation_deg": generator.uniform(-10, 10, 3).tolist(),
    }
    return values


def problem_of(folder: Path, planes: str = "unknown") -> Problem:
    """Return the fit of EA to all frames of a recording."""
    data = Dataset((Recording.open(folder),))
    frames = np.arange(data.num_frames)
    options = resolve_options(TrainingOptions, "ea").model_copy(update={"planes": planes})
    lattice = lattice_of(data, frames)
    return Problem(data, frames, options, covered_domain(data, frames, lattice), lattice)


def true_hand_eye(values: dict[str, Any]) -> Tensor:
    """Return tool_from_camera of the simulator's options."""
    return SimulatorOptions.from_mapping(values, "drawn").hand_eye.tool_from_camera()


def one_case(seed: int, number: int, stops: int | None) -> np.ndarray:
    """Draw and fit two cameras; the second is used at the first so many stops, or at all.

    Returns:
        (4, 6), metres and radians: error and half-width of the transform between them, by the
        joint fit and by two separate ones.
    """
    generator = np.random.default_rng([seed, 40, number])
    first, second = drawn_camera(generator), drawn_camera(generator)
    with tempfile.TemporaryDirectory() as folder:
        front, rear = Path(folder) / "front", Path(folder) / "rear"
        simulate(first, front)
        simulate(second | {"robot_of": str(front)}, rear, num_frames=stops)
        problems = [problem_of(front), problem_of(rear)]
        joint = fit_together(problems)
        alone = [fit(one.dataset, one.frames, one.options, one.domain) for one in problems]
    true = se3.inverse(true_hand_eye(first)) @ true_hand_eye(second)
    found, covariance = joint.between(0, 1)
    transforms = [one.solution.parameters.tool_from_camera for one in alone]
    apart = se3.inverse(transforms[0]) @ transforms[1]
    carried = se3.inverse(apart) @ se3.GENERATORS.double() @ apart
    turns = torch.stack([carried[:, 2, 1], carried[:, 0, 2], carried[:, 1, 0]])
    slope = torch.cat([carried[:, :3, 3].T, turns])
    both = slope @ alone[0].hand_eye_covariance @ slope.T + alone[1].hand_eye_covariance
    quantile = student_quantile(39 / 40, joint.covariance.degrees_of_freedom)
    rows = [se3.log(se3.inverse(true) @ found), quantile * covariance.diagonal().sqrt()]
    rows += [se3.log(se3.inverse(true) @ apart), quantile * both.diagonal().sqrt()]
    return torch.stack(rows).numpy()


def tables(rows: list[np.ndarray]) -> str:
    """Return coverage of each component, and the errors of both ways."""
    joint, joint_half, alone, alone_half = np.stack(rows, axis=1)
    lines = []
    for name, off, half in (("together", joint, joint_half), ("alone", alone, alone_half)):
        held = np.abs(off) <= half
        counted = [share(column) for column in (*held.T, held.ravel())]
        lines.append((name, len(rows), *(f"{one.value:.2f}" for one in counted), counted[-1]))
    sizes = []
    for name, off in (("together", joint), ("alone", alone)):
        rms = 1e3 * np.sqrt(np.mean(np.square(off), axis=0))
        middle = 1e3 * np.median(np.abs(off), axis=0)
        cells = [f"{a:.2f} ({b:.2f})" for a, b in zip(rms, middle, strict=True)]
        sizes.append((name, len(rows), *cells))
    ratio = np.sqrt(np.mean(np.square(joint), axis=0) / np.mean(np.square(alone), axis=0))
    sizes.append(("ratio of RMS", len(rows), *(f"{one:.2f}" for one in ratio)))
    heads = ("95 % intervals, fitted", "n", *AXES)
    return (
        f"{table((*heads, 'all', 'all, with limits'), lines)}\n\n"
        f"{table(('RMS (median) error, mm or mrad', 'n', *AXES), sizes)}"
    )


@click.command(context_settings={"help_option_names": ["-h", "--help"]})
@click.option("--seed", type=int, required=True)
@click.option("--count", default=100, show_default=True)
@click.option("--stops", type=int, help="Stops at which the second camera is used; all by default.")
def main(seed: int, count: int, stops: int | None) -> None:
    """Measure the coverage of intervals and the error between two cameras."""
    torch.set_num_threads(1)
    numbers = tqdm(range(count), leave=False)
    click.echo(tables([one_case(seed, number, stops) for number in numbers]))


if __name__ == "__main__":
    main()
