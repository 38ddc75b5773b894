"""Is what changed since a calibration named, and does a bumped camera find its place again?

    python -m benchmarks.carry_on changes --seed S --count 40
    python -m benchmarks.carry_on pool --seed S --count 10

`changes`: every draw has a camera and a robot of its own. It is calibrated before a measured wall
from 30 poses; then it takes 10 frames of another wall, whose plane nobody measured, unchanged, with
the mount bumped by 8 mm and 1 degree, with a constant of 3 to 8 mm more, and as another camera that
is mounted elsewhere. `pool`: a camera type is known from 6 units; a new one is calibrated from few
poses, with the type and without, and compared on held-out views. Draws are independent; shares have
Wilson intervals.
"""

import json
import math
import tempfile
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import click
import numpy as np
import torch
from tqdm import tqdm

from benchmarks.hand_eye_bias import hand_eye_error
from benchmarks.sealed.scores import share, table
from benchmarks.timing import write
from tofcorr.data.recording import Recording
from tofcorr.estimation.planes import marginal_hessian
from tofcorr.estimation.robust import student_quantile
from tofcorr.geometry import se3
from tofcorr.options import resolve_options
from tofcorr.simulation.options import SimulatorOptions
from tofcorr.simulation.simulator import simulate
from tofcorr.training.calibration import TrainingOptions
from tofcorr.training.run import TrainingResult, train
from tofcorr.training.update import update

Values = dict[str, Any]
STATES = {
    "unchanged": "nothing",
    "bumped": "mount",
    "warmer": "temperature",
    "warmer room": "temperature",
    "another camera": "camera",
}
# Of the other wall's recorded plane, which is a mere start: metres and radians.
UNMEASURED = 0.03


def drawn_camera(rng: np.random.Generator, repeatability: float) -> Values:
    """Return the simulator's options of a calibration recording; repeatability in mm and mrad."""
    values = resolve_options(SimulatorOptions, "demo").to_mapping()
    matrix = [[45.0, 0.0, 16.1], [0.0, 45.0, 12.0], [0.0, 0.0, 1.0]]
    values["camera"] |= {"width": 32, "height": 25, "K": matrix}
    values["scene"]["subsamples"] = 2
    values["seed"] = int(rng.integers(1 << 30))
    values["shots"] = [{"target": "white", "poses": 12}, {"target": "checkerboard", "poses": 18}]
    values["robot"] |= {"repeatability_mm": repeatability, "repeatability_mrad": repeatability}
    return another_camera(values, rng, 20.0)


def another_camera(values: Values, rng: np.random.Generator, constant_mm: float) -> Values:
    """Return the options with another unit of the camera type."""
    values = json.loads(json.dumps(values))
    delays = values["sensor"]["delays"]
    delays["constant_mm"] += float(rng.normal(0, constant_mm))
    delays["clock_deviation"] += float(rng.normal(0, 0.003))
    for name in ("row_slope_mm", "column_slope_mm", "bowl_mm"):
        delays["pixel"][name] += float(rng.normal(0, 3))
    delays["amplitude"]["scale_mm"] *= float(rng.uniform(0.8, 1.25))
    return values


def later(values: Values, state: str, rng: np.random.Generator, frames: int) -> Values:
    """Return the options of the new frames of a camera that has changed."""
    values = json.loads(json.dumps(values))
    values["seed"] = int(rng.integers(1 << 30))
    values["shots"] = [{"target": str(rng.choice(["white", "checkerboard"])), "poses": frames}]
    if state == "another camera":
        values = another_camera(values, rng, 10.0)
    if state in ("bumped", "another camera"):
        twist = rng.normal(size=(2, 3))
        twist *= np.array([[8e-3], [math.radians(1)]]) / np.linalg.norm(twist, axis=1)[:, None]
        mount = SimulatorOptions.from_mapping(values, "drawn").hand_eye.tool_from_camera()
        moved = mount @ se3.exp(torch.from_numpy(twist.ravel()))
        alone = se3.assemble(moved[:3, :3], torch.zeros(3).double())
        turn = torch.rad2deg(se3.log(alone)[3:]).tolist()
        shift = (1e3 * moved[:3, 3]).tolist()
        values["hand_eye"] |= {"translation_mm": shift, "rotation_deg": turn}
    if state == "warmer":
        sign = float(rng.choice([-1, 1]))
        values["sensor"]["delays"]["constant_mm"] += sign * float(rng.uniform(3, 8))
    if state == "warmer room":
        warmer = float(rng.choice([-1, 1])) * float(rng.uniform(3, 8))
        values["conditions"] = {"room_temperature_c": 22 + warmer}
        effect = {"name": "room_temperature", "reference_c": 22.0, "per_degree": 1e-3}
        values["effects"] = [effect]
    return values


def one_draw(
    number: int, seed: int, repeatability: float, frames: int, folder: Path
) -> list[Values]:
    """Calibrate once, and update in every state; return a line for each."""
    rng = np.random.default_rng([seed, 37, number])
    values = drawn_camera(rng, repeatability)
    simulate(SimulatorOptions.from_mapping(values, "drawn"), folder / "first")
    options = resolve_options(TrainingOptions, "ea", ("split.test_fraction=0", "advice=0"))
    options = options.model_copy(update={"figures": False})
    train(folder / "first", options, out=folder / "run")
    lines = []
    for state, expected in STATES.items():
        new = SimulatorOptions.from_mapping(later(values, state, rng, frames), "drawn")
        path = folder / state.replace(" ", "_")
        recording = moved_planes(simulate(new, path), rng)
        found = update(folder / "run", recording, planes="unknown", figures=False)
        said, fit = found.report["update"], found.fit
        true = new.hand_eye.tool_from_camera()
        error = hand_eye_error(true, fit.solution.parameters.tool_from_camera)
        quantile = student_quantile(0.975, fit.covariance.degrees_of_freedom)
        half = quantile * fit.hand_eye_covariance.diagonal().sqrt().view(2, 3)
        lines.append(
            {
                "draw": number,
                "state": state,
                "said": said["explanations"][0]["changed"],
                "right": said["explanations"][0]["changed"] == expected,
                "probability": said["explanations"][0]["probability"],
                "error_mm": (1e3 * error[0]).tolist(),
                "error_deg": torch.rad2deg(error[1]).tolist(),
                "covered": (error.abs() <= half).flatten().tolist(),
                "explanations": said["explanations"],
                "sentence": said["sentence"],
                "bound_mm": bound(found),
            }
        )
    return lines


def moved_planes(recording: Recording, rng: np.random.Generator) -> Recording:
    """Return a recording whose planes are a mere start, one for all frames."""
    frames = recording.frames
    normal = frames.normal_world[0] + rng.normal(0, UNMEASURED, 3)
    normals = np.tile(normal / np.linalg.norm(normal), (len(frames.offset), 1))
    offset = frames.offset + rng.normal(0, UNMEASURED)
    return replace(recording, frames=replace(frames, normal_world=normals, offset=offset))


def bound(found: TrainingResult) -> float:
    """Return the standard error of the hand-eye's place if all coefficients were known, mm.

    It is that of the poses, which scatter, before a wall at an unknown place: no prior can be
    better. All directions together, root of the sum of squares.
    """
    fit = found.fit
    hessian = marginal_hessian(fit.moments, fit.optimum, fit.walls and fit.walls.walls)
    known = torch.linalg.inv(hessian[:6, :6] / fit.residual_variance)
    return 1e3 * math.sqrt(float(known.diagonal()[:3].sum()))


def tables(lines: list[Values]) -> str:
    """Return how often each state was named, and how far the hand-eye is off."""
    head = (
        "state",
        "draws",
        "named right",
        "named as",
        "off, median mm",
        "95 %",
        "x, y alone, 95 %",
    )
    head += ("turned, 95 %, deg", "0.5 mm and 0.05 deg held", "intervals hold", "bound, mm")
    rows = []
    for state in STATES:
        own = [one for one in lines if one["state"] == state]
        off, turned = (np.array([one[key] for one in own]) for key in ("error_mm", "error_deg"))
        size, turn = np.linalg.norm(off, axis=1), np.linalg.norm(turned, axis=1)
        named = Counter(one["said"] for one in own)
        close = share((size < 0.5) & (turn < 0.05))
        across = np.linalg.norm(off[:, :2], axis=1)
        rows.append(
            (
                state,
                len(own),
                share(one["right"] for one in own),
                ", ".join(f"{name} {count}" for name, count in named.most_common()),
                f"{np.median(size):.2f}",
                *(f"{np.quantile(one, 0.95):.2f}" for one in (size, across)),
                f"{np.quantile(turn, 0.95):.3f}",
                close,
                share(np.array([one["covered"] for one in own]).ravel().tolist()),
                f"{np.median([one['bound_mm'] for one in own]):.2f}",
            )
        )
    return table(head, rows)


@click.group(context_settings={"help_option_names": ["-h", "--help"]})
def group() -> None:
    """Measure updates of a calibration, and the prior of a camera type."""
    torch.set_num_threads(1)


@group.command()
@click.option("--seed", type=int, required=True)
@click.option("--count", default=40, show_default=True)
@click.option("--repeatability", default=0.1, show_default=True, help="Of the robot, mm and mrad.")
@click.option("--frames", default=10, show_default=True)
@click.option("--out", type=click.Path(path_type=Path), help="JSON file for every update.")
def changes(seed: int, count: int, repeatability: float, frames: int, out: Path | None) -> None:
    """Name what changed, and find the mount again."""
    lines: list[Values] = []
    for number in tqdm(range(count), desc="cameras", disable=None):
        with tempfile.TemporaryDirectory() as folder:
            lines += one_draw(number, seed, repeatability, frames, Path(folder))
    click.echo(tables(lines))
    write(lines, out)


if __name__ == "__main__":
    group()
