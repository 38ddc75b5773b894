"""Do the intervals of cameras calibrated together hold, and is that better than each alone?

    python -m benchmarks.rig cameras --seed S --count 100
    python -m benchmarks.rig cell    --seed S --count 100
    python -m benchmarks.rig joints  --seed S --count 100 [--lengths 0.75]

Each case has two cameras with errors of their own on one robot of 20 to 40 stops, before one wall
whose place is unknown. Their hand-eye transforms differ at random. EA is fitted to both together,
and to each alone. Compared is the transform from one camera to the other.

`cell`: both cameras stand still, and a target is held before them at as many stations. Its plane is
measured in the first camera's frame, to 1 mm and 1 mrad.

`joints`: one camera on an arm of six axes whose joints have offsets of 0.2 degrees, half of the
time before a wall that was measured. EA is fitted with the offsets, and without. `--lengths`: so
are the errors of the links' lengths, drawn with this standard deviation (mm), which is known.
"""

import math
import tempfile
from collections.abc import Sequence
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
from tofcorr.fit.joint import adjoint, fit_together
from tofcorr.fit.problem import Problem
from tofcorr.geometry import se3
from tofcorr.geometry.rays import plane_in_frame
from tofcorr.options import resolve_options
from tofcorr.pixels.dataset import Dataset
from tofcorr.pixels.lattice import covered_domain, lattice_of
from tofcorr.simulation.options import ArmOptions, SimulatorOptions
from tofcorr.simulation.simulator import simulate
from tofcorr.training.calibration import TrainingOptions, halves
from tofcorr.training.rig import around_cell
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


def problem_of(data: Dataset, planes: str = "unknown", changes: tuple[str, ...] = ()) -> Problem:
    """Return the fit of EA to a recording, of the frames and pixels that `tofcorr rig` uses."""
    changes = ("split.test_fraction=0", f"planes={planes}", *changes)
    options = resolve_options(TrainingOptions, "ea", changes)
    data, options, _, left_out = inspected(data, options, force=True)
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
        problems = [problem_of(recorded(one), changes=changes) for one in (front, rear)]
        joint = fit_together(problems)
        alone = [fit(one.dataset, one.frames, one.options, one.domain) for one in problems]
    true = se3.inverse(true_hand_eye(first)) @ true_hand_eye(second)
    found, covariance = joint.between(0, 1)
    transforms = [one.solution.parameters.tool_from_camera for one in alone]
    apart = se3.inverse(transforms[0]) @ transforms[1]
    slope = adjoint(se3.inverse(apart))
    both = slope @ alone[0].hand_eye_covariance @ slope.T + alone[1].hand_eye_covariance
    quantile = student_quantile(39 / 40, joint.covariance.degrees_of_freedom)
    rows = [se3.log(se3.inverse(true) @ found), quantile * covariance.diagonal().sqrt()]
    rows += [se3.log(se3.inverse(true) @ apart), quantile * both.diagonal().sqrt()]
    return torch.stack(rows).numpy()


def recorded(folder: Path) -> Dataset:
    """Return a recording as a data set."""
    return Dataset((Recording.open(folder),))


def standing(data: Dataset, mount: Tensor, generator: np.random.Generator) -> Dataset:
    """Return a recording as of a camera that stands still before a target moved by hand."""
    pose = data.column("world_from_tool") @ mount
    normal, offset = plane_in_frame(data.column("normal_world"), data.column("offset"), pose)
    off = torch.from_numpy(generator.normal(0, 1e-3, (len(pose), 4)))
    normal = torch.nn.functional.normalize(normal + off[:, :3], dim=1)
    return data.with_columns(
        world_from_tool=np.tile(np.eye(4), (len(pose), 1, 1)),
        normal_world=normal.numpy(),
        offset=(offset + off[:, 3]).numpy(),
    )


def one_cell(seed: int, number: int) -> np.ndarray:
    """Draw and fit two cameras that stand still.

    Returns:
        (2, 6), metres and radians: error and half-width of the transform between them.
    """
    generator = np.random.default_rng([seed, 42, number])
    drawn = drawn_camera(generator), drawn_camera(generator)
    mounts = [true_hand_eye(one) for one in drawn]
    with tempfile.TemporaryDirectory() as folder:
        paths = Path(folder) / "front", Path(folder) / "rear"
        simulate(drawn[0], paths[0])
        simulate(drawn[1] | {"robot_of": str(paths[0])}, paths[1])
        pair = zip(paths, mounts, strict=True)
        still = {one.name: standing(recorded(one), mount, generator) for one, mount in pair}
        fixed = ("hand_eye.estimate=no",), ()
        each = zip(around_cell(still).values(), fixed, strict=True)
        joint = fit_together([problem_of(one, "known", changes) for one, changes in each])
    found, covariance = joint.between(0, 1)
    quantile = student_quantile(39 / 40, joint.covariance.degrees_of_freedom)
    off = se3.log(se3.inverse(mounts[1]) @ mounts[0] @ found)
    return torch.stack([off, quantile * covariance.diagonal().sqrt()]).numpy()


def cell_table(rows: list[np.ndarray]) -> str:
    """Return errors and coverage of each component."""
    off, half = np.stack(rows, axis=1)
    held = [share(one) for one in (np.abs(off) <= half).T]
    sizes = np.sqrt(np.mean(off**2, axis=0)), np.median(np.abs(off), axis=0)
    cells = [f"{1e3 * rms:.2f} ({1e3 * middle:.2f})" for rms, middle in zip(*sizes, strict=True)]
    lines = [("RMS (median), mm or mrad", *cells, ""), ("95 % intervals hold", *held)]
    lines[1] = (*lines[1], share((np.abs(off) <= half).ravel()))
    return table((f"{len(rows)} cells", *AXES, "all"), lines)


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


def one_arm(seed: int, number: int, tolerance_mm: float | None) -> dict[str, np.ndarray]:
    """Draw and fit one camera on an arm.

    Args:
        seed: Of all cases.
        number: Of this one.
        tolerance_mm: Standard deviation of the lengths' errors; None: lengths are right.

    Returns:
        `joints`, (3, J): error and half-width of each offset, NaN where it was named as not
        determined, and their ratio to the tolerance's, degrees or mm; `known`: whether the wall was
        measured; `mounts`, (4, 6): error and half-width of the hand-eye with offsets and without,
        metres and radians.
    """
    generator = np.random.default_rng([seed, 41, number])
    values, known = drawn_camera(generator), number % 2 == 0
    arm = ArmOptions().arm(tolerance_mm or math.inf)
    offsets, unit = generator.normal(0, OFFSETS_DEG, 6), np.where(arm.turns, 180 / math.pi, 1e3)
    lengths = generator.normal(0, tolerance_mm or 0, int(arm.is_length.sum()))
    values["scene"] = {"plane": {"normal": [-1, 0, 0], "offset_m": 1.3}}
    off = {"offsets_deg": offsets.tolist(), "lengths_mm": lengths.tolist()}
    values["robot"] |= {"distance_m": [0.5, 1.1], "arm": off}
    with tempfile.TemporaryDirectory() as folder:
        simulate(values, Path(folder) / "wall")
        problem = problem_of(recorded(Path(folder) / "wall"), "known" if known else "unknown")
        both = fit_together([problem], arm), fit_together([problem])
    place, mounts = both[0].together.places()[-1], list[Tensor]()
    quantile = student_quantile(39 / 40, both[0].covariance.degrees_of_freedom)
    spread = both[0].covariance.matrix.diagonal()[place].sqrt()
    joints = np.full((3, len(arm.names)), np.nan)
    chosen = list(both[0].chosen)
    drawn = arm.placed(torch.from_numpy(offsets), torch.from_numpy(lengths)).numpy()[chosen]
    joints[0, chosen] = (both[0].together.offsets.numpy() * unit[chosen]) - drawn
    joints[1, chosen] = quantile * spread.numpy() * unit[chosen]
    joints[2, chosen] = spread.numpy() / arm.tolerance.numpy()[chosen]
    # The last joint's offset is in the hand-eye: that is what is said, and no error of it. So is
    # the error of the last length, along the same axis.
    along = lengths[-1] / 1e3 if len(lengths) else 0.0
    last = torch.tensor([0, 0, along, 0, 0, math.radians(offsets[5])], dtype=torch.float64)
    true = se3.exp(last) @ true_hand_eye(values)
    for joint in both:
        found = joint.fits[0]
        off = se3.log(se3.inverse(true) @ found.solution.parameters.tool_from_camera)
        mounts += [off, quantile * found.hand_eye_covariance.diagonal().sqrt()]
    return {"joints": joints, "known": np.array(known), "mounts": torch.stack(mounts).numpy()}


def arm_tables(rows: list[dict[str, np.ndarray]], names: Sequence[str]) -> str:
    """Return how often offsets are determined, their intervals and errors, and the hand-eye's."""
    joints, mounts, known = (
        np.stack([one[key] for one in rows]) for key in ("joints", "mounts", "known")
    )
    lines = []
    for name, own in (("measured", joints[known]), ("unknown", joints[~known])):
        found, half, share_left = own.transpose(1, 0, 2)
        for k, joint in enumerate(names):
            seen = np.isfinite(found[:, k])
            better = int((2 * share_left[:, k] ** 2 < 1).sum())
            held = share(np.abs(found[seen, k]) <= half[seen, k])
            off = f"{math.sqrt(np.mean(found[seen, k] ** 2)):.3f}" if seen.any() else ""
            stated = held if seen.any() else ""
            lines.append((name, joint, len(own), int(seen.sum()), better, stated, off))
    seen = np.isfinite(joints[:, 0])
    held = share((np.abs(joints[:, 0]) <= joints[:, 1])[seen])
    lines.append(("all", "all", len(rows), int(seen.sum()), "", held, ""))
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
    heads = ("wall", "joint", "n", "fitted", "determined", "95 % intervals hold", "RMS, deg, mm")
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
def cell(seed: int, count: int) -> None:
    """Measure the coverage of intervals and the error between two cameras that stand still."""
    numbers = tqdm(range(count), leave=False, disable=None)
    click.echo(cell_table([one_cell(seed, number) for number in numbers]))


@main.command()
@_SEED
@_COUNT
@click.option("--lengths", type=float, help="Standard deviation of the lengths' errors, mm.")
def joints(seed: int, count: int, lengths: float | None) -> None:
    """Measure which offsets are determined, their intervals, and what they do to the hand-eye."""
    numbers = tqdm(range(count), leave=False, disable=None)
    names = ArmOptions().arm(lengths or math.inf).names
    click.echo(arm_tables([one_arm(seed, number, lengths) for number in numbers], names))


if __name__ == "__main__":
    main()
