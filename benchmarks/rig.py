"""Do the intervals of cameras calibrated together hold, and is that better than each alone?

    python -m benchmarks.rig cameras --seed S --count 100
    python -m benchmarks.rig joints  --seed S --count 100

Each case has two cameras with errors of their own on one robot of 20 to 40 stops, before one wall
whose place is unknown. Their hand-eye transforms differ at random. EA is fitted to both together,
and to each alone. Compared is the transform from one camera to the other.

`joints`: one camera on an arm of six axes whose joints have offsets of 0.2 degrees, half of the
time before a wall that was measured. EA is fitted with the offsets, and without.
"""

import math
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
from tofcorr.simulation.options import ArmOptions, SimulatorOptions
from tofcorr.simulation.simulator import simulate
from tofcorr.training.calibration import TrainingOptions, halves
from tofcorr.training.run import inspected

OFFSETS_DEG = 0.2  # standard deviation of the offsets of the joints
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


def problem_of(folder: Path, planes: str = "unknown", changes: tuple[str, ...] = ()) -> Problem:
    """Return the fit of EA to a recording, of the frames and pixels that `tofcorr rig` uses."""
    changes = ("split.test_fraction=0", f"planes={planes}", *changes)
    options = resolve_options(TrainingOptions, "ea", changes)
    data, options, _, left_out = inspected(Dataset((Recording.open(folder),)), options, force=True)
    frames, _ = halves(data, options, left_out)
    lattice = lattice_of(data, frames)
    return Problem(data, frames, options, covered_domain(data, frames, lattice), lattice)


def true_hand_eye(values: dict[str, Any]) -> Tensor:
    """Return tool_from_camera of the simulator's options."""
    return SimulatorOptions.from_mapping(values, "drawn").hand_eye.tool_from_camera()


def one_case(seed: int, number: int, stops: int | None, changes: tuple[str, ...]) -> np.ndarray:
    """Draw and fit two cameras; the second is used at the first so many stops, or at all.

    Args:
        seed: Of all cases.
        number: Of this one.
        stops: None: all.
        changes: Of the options, `KEY=VALUE`.

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
        problems = [problem_of(one, changes=changes) for one in (front, rear)]
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


def one_arm(seed: int, number: int) -> dict[str, np.ndarray]:
    """Draw and fit one camera on an arm.

    Returns:
        `joints`, (3, 6): error and half-width of each offset, NaN where it was named as not
        determined, and the offset, degrees; `known`: whether the wall was measured; `mounts`,
        (4, 6): error and half-width of the hand-eye with offsets and without, metres and radians.
    """
    generator = np.random.default_rng([seed, 41, number])
    values, known = drawn_camera(generator), number % 2 == 0
    offsets = generator.normal(0, OFFSETS_DEG, 6)
    values["scene"] = {"plane": {"normal": [-1, 0, 0], "offset_m": 1.3}}
    values["robot"] |= {"distance_m": [0.5, 1.1], "arm": {"offsets_deg": offsets.tolist()}}
    with tempfile.TemporaryDirectory() as folder:
        simulate(values, Path(folder) / "wall")
        problem = problem_of(Path(folder) / "wall", "known" if known else "unknown")
        both = fit_together([problem], ArmOptions().arm()), fit_together([problem])
    place, mounts = both[0].together.places()[-1], list[Tensor]()
    quantile = student_quantile(39 / 40, both[0].covariance.degrees_of_freedom)
    spread = both[0].covariance.matrix.diagonal()[place].sqrt()
    joints = np.full((3, 6), np.nan)
    chosen = list(both[0].chosen)
    joints[0, chosen] = np.rad2deg(both[0].together.offsets.numpy()) - offsets[chosen]
    joints[1, chosen] = np.rad2deg(quantile * spread.numpy())
    joints[2] = offsets
    # The last joint's offset is in the hand-eye: that is what is said, and no error of it.
    last = torch.tensor([0, 0, 0, 0, 0, math.radians(offsets[5])], dtype=torch.float64)
    true = se3.exp(last) @ true_hand_eye(values)
    for joint in both:
        found = joint.fits[0]
        off = se3.log(se3.inverse(true) @ found.solution.parameters.tool_from_camera)
        mounts += [off, quantile * found.hand_eye_covariance.diagonal().sqrt()]
    return {"joints": joints, "known": np.array(known), "mounts": torch.stack(mounts).numpy()}


def arm_tables(rows: list[dict[str, np.ndarray]]) -> str:
    """Return how often offsets are determined, their intervals and errors, and the hand-eye's."""
    joints, mounts, known = (
        np.stack([one[key] for one in rows]) for key in ("joints", "mounts", "known")
    )
    lines = []
    for name, own in (("measured", joints[known]), ("unknown", joints[~known])):
        found, half, _ = own.transpose(1, 0, 2)
        for k, joint in enumerate(ArmOptions().arm().names):
            seen = np.isfinite(found[:, k])
            held = share(np.abs(found[seen, k]) <= half[seen, k])
            off = f"{math.sqrt(np.mean(found[seen, k] ** 2)):.3f}" if seen.any() else ""
            lines.append((name, joint, len(own), int(seen.sum()), held if seen.any() else "", off))
    seen = np.isfinite(joints[:, 0])
    held = share((np.abs(joints[:, 0]) <= joints[:, 1])[seen])
    lines.append(("all", "all", len(rows), int(seen.sum()), held, ""))
    sizes = []
    for name, off, half in (
        ("with", *mounts[:, :2].transpose(1, 0, 2)),
        ("without", *mounts[:, 2:].transpose(1, 0, 2)),
    ):
        place, turn = (
            np.linalg.norm(1e3 * off[:, part], axis=1) for part in (slice(3), slice(3, 6))
        )
        rms = (f"{math.sqrt(np.mean(one**2)):.2f} ({np.median(one):.2f})" for one in (place, turn))
        sizes.append((name, len(rows), *rms, share((np.abs(off) <= half).ravel())))
    heads = ("wall", "joint", "n", "determined", "95 % intervals hold", "RMS error, deg")
    hand_eye = ("offsets", "n", "hand-eye RMS (median), mm", "mrad", "95 % intervals hold")
    return f"{table(heads, lines)}\n\n{table(hand_eye, sizes)}"


@click.group(context_settings={"help_option_names": ["-h", "--help"]})
def main() -> None:
    """Measure what a joint fit finds: of two cameras, or of a robot's joints."""
    torch.set_num_threads(1)


_SEED = click.option("--seed", type=int, required=True)
_COUNT = click.option("--count", default=100, show_default=True)


@main.command()
@_SEED
@_COUNT
@click.option("--stops", type=int, help="Stops at which the second camera is used; all by default.")
@click.option("--set", "changes", multiple=True, help="KEY=VALUE, an option of both fits.")
def cameras(seed: int, count: int, stops: int | None, changes: tuple[str, ...]) -> None:
    """Measure the coverage of intervals and the error between two cameras."""
    numbers = tqdm(range(count), leave=False, disable=None)
    click.echo(tables([one_case(seed, number, stops, changes) for number in numbers]))


@main.command()
@_SEED
@_COUNT
def joints(seed: int, count: int) -> None:
    """Measure which offsets are determined, their intervals, and what they do to the hand-eye."""
    numbers = tqdm(range(count), leave=False, disable=None)
    click.echo(arm_tables([one_arm(seed, number) for number in numbers]))


if __name__ == "__main__":
    main()
