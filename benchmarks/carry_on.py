"""Is what changed since a calibration named, and does a bumped camera find its place again?

    python -m benchmarks.carry_on changes --seed S --count 40
    python -m benchmarks.carry_on bump --seed S --count 20
    python -m benchmarks.carry_on pool --seed S --count 10

`changes`: every draw has a camera and a robot of its own. It is calibrated before a measured wall
from 30 poses; then it takes 10 frames of another wall, whose plane nobody measured, unchanged, with
the mount bumped by 8 mm and 1 degree, with a constant of 3 to 8 mm more, and as another camera that
is mounted elsewhere. `bump`: of 80 frames after a bump some are used, drawn at random or by advice,
each the one that the update of all expects to tell most. `pool`: a camera type is known from 6
units; a new one is calibrated from few poses, with the type and without, and compared on held-out
views. Then ten frames of another unit in place of the first, and of the first one bumped and warmer
or only bumped, are named with the type and without. Draws are independent; shares have Wilson
intervals.
"""

import json
import math
import tempfile
from collections import Counter
from collections.abc import Sequence
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
from tofcorr.correction.state import save_values
from tofcorr.data.arrays import IMAGE_ARRAYS
from tofcorr.data.recording import Recording
from tofcorr.errors import TofcorrError
from tofcorr.estimation.moments import MomentObjective
from tofcorr.estimation.planes import joint_image_equations, within_prior
from tofcorr.estimation.robust import student_quantile
from tofcorr.geometry import se3
from tofcorr.options import resolve_options
from tofcorr.pixels.dataset import Dataset, PlaneChoice
from tofcorr.pixels.passes import frame_errors
from tofcorr.simulation.options import SimulatorOptions
from tofcorr.simulation.simulator import simulate
from tofcorr.training.advice import choose_views
from tofcorr.training.calibration import TrainingOptions
from tofcorr.training.pool import CameraType, pool
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
POSES = (5, 7, 10, 15, 20, 30)
FRAMES = (10, 15, 20, 30)
QUIET = resolve_options(
    TrainingOptions, "ea", ("split.test_fraction=0", "advice=0", "figures=false")
)


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


def calibrated_once(
    rng: np.random.Generator, repeatability: float, folder: Path
) -> tuple[Values, TrainingResult]:
    """Draw a camera, and calibrate it; the run is in `folder / "run"`."""
    values = drawn_camera(rng, repeatability)
    simulate(SimulatorOptions.from_mapping(values, "drawn"), folder / "first")
    return values, train(folder / "first", QUIET, out=folder / "run")


def one_draw(
    number: int, seed: int, repeatability: float, frames: int, planes: PlaneChoice, folder: Path
) -> list[Values]:
    """Calibrate once, and update in every state; return a line for each."""
    rng = np.random.default_rng([seed, 37, number])
    values, _ = calibrated_once(rng, repeatability, folder)
    lines = []
    for state, expected in STATES.items():
        new = SimulatorOptions.from_mapping(later(values, state, rng, frames), "drawn")
        path = folder / state.replace(" ", "_")
        recording = simulate(new, path)
        recording = recording if planes == "known" else moved_planes(recording, rng)
        found = update(folder / "run", recording, planes=planes, figures=False)
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
                "bound_mm": bound(found, repeatability),
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


def bound(
    found: TrainingResult, repeatability: float, frames: Sequence[int] | None = None
) -> float:
    """Return the least standard error of the hand-eye's place, all axes together, mm.

    It is that of generalised least squares with all coefficients known, and with the variances of
    pixels and poses: no estimate from these frames of a wall in an unknown place can be better.

    Args:
        found: The update.
        repeatability: Of the robot, mm and mrad.
        frames: Which of its frames; None: all.
    """
    fit = found.fit
    moments, at, walls = fit.moments, fit.optimum, fit.walls and fit.walls.walls
    each = torch.eye(3).double().expand(len(moments.count), 3, 3)
    alone = MomentObjective(within_prior(moments, at, 1e-9 * each)).image_losses(at).sum()
    noise = alone / moments.count.sum()
    # A plane in the tool's frame turns and shifts as the tool does.
    of_poses = noise / (1e-3 * repeatability) ** 2 * each
    images = joint_image_equations(within_prior(moments, at, of_poses), at, walls).hessian / noise
    total = (images if frames is None else images[list(frames)]).sum(dim=0)
    # Without the coefficients: known.
    others = torch.cat([torch.arange(6), torch.arange(at.size, len(total))])
    covariance = torch.linalg.inv(total[others][:, others])
    return 1e3 * math.sqrt(float(covariance.diagonal()[:3].sum()))


def one_bump(number: int, seed: int, repeatability: float, folder: Path) -> list[Values]:
    """Calibrate once, bump the mount, and update with some of 80 frames; a line for each choice."""
    rng = np.random.default_rng([seed, 39, number])
    values, first = calibrated_once(rng, repeatability, folder)
    new = SimulatorOptions.from_mapping(later(values, "bumped", rng, 80), "drawn")
    every = moved_planes(simulate(new, folder / "bumped"), rng)
    old = SimulatorOptions.from_mapping(values, "drawn")
    whole = update(folder / "run", every, planes="unknown", figures=False)
    walls = whole.fit.walls and whole.fit.walls.walls
    images = joint_image_equations(whole.fit.moments, whole.fit.optimum, walls).hessian
    images = images / whole.fit.observability.variance
    # What is known before: the coefficients, by the old calibration.
    before, size = torch.zeros_like(images[0]), whole.fit.optimum.size
    known = first.fit.joint_covariance[6:, 6:]
    before[6:size, 6:size] = torch.linalg.inv(known)
    ways = {"random": rng.permutation(len(images)).tolist()}
    ways["advice"] = choose_views(before, images, max(FRAMES))[0]
    chosen = [(way, order[:number]) for way, order in ways.items() for number in FRAMES]
    results = [("first run", [], old, first), ("all", list(range(len(images))), new, whole)]
    results += [
        (way, own, new, update(folder / "run", some(every, own), planes="unknown", figures=False))
        for way, own in chosen
    ]
    lines = []
    for way, own, truth, found in results:
        mount = found.fit.solution.parameters.tool_from_camera
        shift, turn = hand_eye_error(truth.hand_eye.tool_from_camera(), mount).norm(dim=1).tolist()
        least = bound(whole, repeatability, own) if own else math.nan
        one = {"way": way, "frames": len(own), "off_mm": 1e3 * shift, "bound_mm": least}
        lines.append(one | {"turned_deg": math.degrees(turn)})
    return lines


def some(recording: Recording, frames: list[int]) -> Recording:
    """Return a recording of some frames."""
    arrays = {
        name: np.array(own)[frames]
        for name in IMAGE_ARRAYS
        if (own := getattr(recording, name)) is not None
    }
    return replace(recording, frames=recording.frames.select(frames), **arrays)


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
@click.option("--planes", default="unknown", type=click.Choice(["unknown", "known"]))
@click.option("--out", type=click.Path(path_type=Path), help="JSON file for every update.")
def changes(seed: int, count: int, *, out: Path | None, **given: Any) -> None:  # noqa: ANN401
    """Name what changed, and find the mount again."""
    lines: list[Values] = []
    for number in tqdm(range(count), desc="cameras", disable=None):
        with tempfile.TemporaryDirectory() as folder:
            lines += one_draw(number, seed, **given, folder=Path(folder))
    click.echo(tables(lines))
    write(lines, out)


@group.command("bump")
@click.option("--seed", type=int, required=True)
@click.option("--count", default=20, show_default=True)
@click.option("--repeatability", default=0.1, show_default=True, help="Of the robot, mm and mrad.")
@click.option("--out", type=click.Path(path_type=Path), help="JSON file for every update.")
def bumps(seed: int, count: int, repeatability: float, out: Path | None) -> None:
    """Find a bumped mount again with more and more frames, random ones and advised ones."""
    lines: list[Values] = []
    for number in tqdm(range(count), desc="cameras", disable=None):
        with tempfile.TemporaryDirectory() as folder:
            lines += one_bump(number, seed, repeatability, Path(folder))
    rows = []
    for way, frames in dict.fromkeys((one["way"], one["frames"]) for one in lines):
        own = [one for one in lines if (one["way"], one["frames"]) == (way, frames)]
        off, turned, least = (
            np.array([one[key] for one in own]) for key in ("off_mm", "turned_deg", "bound_mm")
        )
        sizes = (np.median(off), math.sqrt(np.mean(off**2)), np.median(least))
        close = share((off < 0.5) & (turned < 0.05))
        rows.append((way, frames, len(own), *(f"{one:.2f}" for one in sizes), close))
    head = (
        "frames",
        "number",
        "draws",
        "off, median mm",
        "RMS",
        "bound",
        "0.5 mm and 0.05 deg held",
    )
    click.echo(table(head, rows))
    write(lines, out)


@group.command("pool")
@click.option("--seed", type=int, required=True)
@click.option("--count", default=10, show_default=True)
@click.option("--units", default=6, show_default=True)
@click.option("--repeatability", default=0.3, show_default=True, help="Of the robot, mm and mrad.")
@click.option("--out", type=click.Path(path_type=Path), help="JSON file for every calibration.")
def pooled(seed: int, count: int, units: int, repeatability: float, out: Path | None) -> None:
    """Calibrate a new unit from few poses, with what others of its type have in common."""
    lines: list[Values] = []
    for number in tqdm(range(count), desc="types", disable=None):
        with tempfile.TemporaryDirectory() as folder:
            lines += one_type(number, seed, units, repeatability, Path(folder))
    named, lines = ([one for one in lines if (key in one)] for key in ("said", "poses"))
    rows = []
    for poses in POSES:
        own = [one for one in lines if one["poses"] == poses]
        each = {name: np.array([one["rms_mm"][name] for one in own]) for name in own[0]["rms_mm"]}
        better = share(each["type"] < each["alone"])
        rows.append((poses, len(own), *(f"{np.median(one):.2f}" for one in each.values()), better))
    head = (
        "poses",
        "units",
        "alone, median mm",
        "with the type",
        "coefficients known",
        "type better",
    )
    click.echo(table(head, rows))
    rows = []
    for state, way in dict.fromkeys((one["state"], one["way"]) for one in named):
        own = Counter(one["said"] for one in named if (one["state"], one["way"]) == (state, way))
        said = ", ".join(f"{name} {number}" for name, number in own.most_common())
        rows.append((state, way, own.total(), said))
    click.echo(table(("what happened", "prior", "draws", "named as"), rows))
    write([*lines, *named], out)


def one_type(
    number: int, seed: int, units: int, repeatability: float, folder: Path
) -> list[Values]:
    """Calibrate units of a type, and then one more from few poses; return a line for each."""
    rng = np.random.default_rng([seed, 38, number])
    base, drawn = drawn_camera(rng, repeatability), list[Values]()
    for unit in range(units):
        drawn.append(another_camera(base, rng, 10.0))
        recorded(drawn[-1], rng, 30, folder / f"recording_{unit}")
        train(folder / f"recording_{unit}", QUIET, out=folder / f"run_{unit}")
    pool([folder / f"run_{unit}" for unit in range(units)], out=folder / "type")
    new = another_camera(base, rng, 10.0)
    # Without noise, and at the poses reported: what is left is of the calibration. What the best
    # model of these terms leaves there is no matter of poses.
    held_out = recorded(new, rng, 30, folder / "held_out", noise=False)
    best = train(held_out, QUIET)
    least, size = off(best, held_out), len(best.fit.optimum.coefficients)
    # A type whose units are all this one: no prior can help more.
    exact = CameraType(
        error_model=best.fit.options,
        domain=best.fit.domain,
        mean=best.fit.optimum.coefficients,
        covariance=1e-12 * torch.eye(size).double(),
        units=("this", "this"),
    )
    save_values(folder / "exact", "tofcorr-camera-type", exact.model_dump(), TofcorrError)
    priors = {"alone": None, "type": folder / "type", "coefficients known": folder / "exact"}
    lines = []
    for poses in POSES:
        few = recorded(new, rng, poses, folder / f"few_{poses}")
        found = {
            name: math.sqrt(max(off(train(few, QUIET, prior=prior), held_out) ** 2 - least**2, 0))
            for name, prior in priors.items()
        }
        lines.append({"draw": number, "poses": poses, "rms_mm": found})
    return lines + replaced(base, drawn[0], np.random.default_rng([seed, 99, number]), folder)


def replaced(base: Values, first: Values, rng: np.random.Generator, folder: Path) -> list[Values]:
    """Name what ten frames show of the first unit of a type, or of another in its place."""
    lines = []
    for state in ("another camera", "bumped and warmer", "bumped"):
        now = another_camera(base, rng, 10.0) if state == "another camera" else first
        now = later(now, "bumped", rng, 10)
        if state == "bumped and warmer":
            sign = float(rng.choice([-1, 1]))
            now["sensor"]["delays"]["constant_mm"] += sign * float(rng.uniform(3, 8))
        options = SimulatorOptions.from_mapping(now, "drawn")
        recording = moved_planes(simulate(options, folder / state.replace(" ", "_")), rng)
        for way, prior in (("none", None), ("type", folder / "type")):
            given: Values = {"planes": "unknown", "figures": False, "prior": prior}
            said = update(folder / "run_0", recording, **given).report["update"]["explanations"]
            lines.append({"state": state, "way": way, "said": said[0]["changed"], "all": said})
    return lines


def off(found: TrainingResult, held_out: Recording) -> float:
    """Return the RMS distance of corrected points to their planes, mm."""
    errors = frame_errors(Dataset((held_out,)), {"after": found.fit.model}, "cpu", 1.0)["after"]
    return errors["to_plane"].rms_mm(np.arange(held_out.num_frames))


def recorded(
    values: Values, rng: np.random.Generator, poses: int, out: Path, *, noise: bool = True
) -> Recording:
    """Simulate a recording of so many poses, two in five before a white wall."""
    white = max(2 * poses // 5, 1)
    shots = [
        {"target": "white", "poses": white},
        {"target": "checkerboard", "poses": poses - white},
    ]
    own = values | {"seed": int(rng.integers(1 << 30)), "shots": shots}
    return simulate(SimulatorOptions.from_mapping(own, "drawn"), out, noise=noise)


if __name__ == "__main__":
    group()
