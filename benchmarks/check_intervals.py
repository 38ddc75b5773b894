"""Do the intervals of `tofcorr check` hold the truth? And how small a drift do they show?

    python -m benchmarks.check_intervals --count 200 --seed 0 --out check_intervals.json

Every draw has a camera of its own (noise, wiggling, pixel delays, amplitude law), a robot of its
own, a training recording of 16 to 40 poses, and a model that describes the camera more or less
well. Then the same camera takes frames to check, half of the time at nearly one distance. Unchanged
it takes 1, 3, 5, 10, 20 or 40; with an offset of 5 mm it takes 40, of which the first 1, 3, 5, ...
are checked too. Both are checked with each kind of wall. Draws are independent; shares have Wilson
intervals.
"""

import itertools
import json
import math
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click
import numpy as np
import torch
from tqdm import tqdm

from benchmarks.sealed.scores import Limits, share, table
from benchmarks.timing import write
from benchmarks.wrong_recordings.clean import drawn_simulator
from tofcorr.data.recording import Recording
from tofcorr.drift.check import check_drift
from tofcorr.drift.offset import OffsetSums, Wall
from tofcorr.errors import TofcorrError
from tofcorr.fit.reference import estimate_reference, unknown_reference
from tofcorr.options import resolve_options
from tofcorr.pixels.dataset import Dataset
from tofcorr.simulation.options import SimulatorOptions
from tofcorr.simulation.simulator import simulate
from tofcorr.training.calibration import TrainingOptions
from tofcorr.training.run import calibration_state, train

Values = dict[str, Any]
WALLS: tuple[Wall, ...] = ("per_image", "one", "recorded")
FRAMES = (1, 3, 5, 10, 20, 40)
MODELS = ("ea", "ea", "e0", "eb", "ea_log")
# The drift to be found, millimetres, and how far the check's distances reach from their middle
# where it looks at nearly one distance, metres.
DRIFT_MM, REACH = 5.0, 0.2


def drawn_camera(generator: np.random.Generator) -> Values:
    """Return the simulator's options of a training recording."""
    values = drawn_simulator(generator)
    matrix = [[45.0, 0.0, 16.0], [0.0, 45.0, 12.5], [0.0, 0.0, 1.0]]
    values["camera"] |= {"width": 32, "height": 25, "K": matrix}
    targets = ("white", "checkerboard")
    values["shots"] = [{"target": one, "poses": int(generator.integers(8, 21))} for one in targets]
    if generator.random() < 0.5:
        law = {"law": "log", "scale_mm": float(generator.uniform(5, 25)), "electrons": 1.2e6}
        values["sensor"]["delays"]["amplitude"] = law
    values["scene"] = {"subsamples": 2}
    return values


def check_options(training: Values, frames: int, generator: np.random.Generator) -> Values:
    """Return the options of the frames to check: the same camera and robot, later."""
    values = json.loads(json.dumps(training))
    values["seed"] = training["seed"] + 1
    target = str(generator.choice(["white", "checkerboard"]))
    values["shots"] = [{"target": target, "poses": frames}]
    if generator.random() < 0.5:
        low, high = values["robot"]["distance_m"]
        middle = float(generator.uniform(low, high))
        nearest, farthest = max(low, middle - REACH), min(high, middle + REACH)
        values["robot"]["distance_m"] = [nearest, farthest]
    return values


def one_draw(number: int, seed: int, folder: Path) -> list[Values]:
    """Train once and check twice, unchanged and drifted; return a line for each wall and state."""
    generator = np.random.default_rng([seed, 16, number])
    frames = FRAMES[number % len(FRAMES)]
    camera = drawn_camera(generator)
    simulate(SimulatorOptions.from_mapping(camera, "drawn"), folder / "train")
    model = MODELS[int(generator.integers(len(MODELS)))]
    options = resolve_options(TrainingOptions, model).model_copy(update={"advice": 0})
    result = train(folder / "train", options)
    state, seen = calibration_state(result.data, options, result.fit), result.calibration.frames
    reference = estimate_reference(result.data, seen, result.fit, state.noise)
    later = check_options(camera, max(FRAMES), generator)
    same = recorded(later, folder / "unchanged", frames, 0.0)
    moved = recorded(later, folder / "drifted", max(FRAMES), DRIFT_MM)
    lines = []
    for wall in WALLS:
        found = check_drift(state, same, wall, reference=reference)
        said = {"verdict": found.verdict, "headline": found.headline}
        lines.append(_line(wall, frames, 0.0, found.offset, found.interval) | said)
        own = reference or unknown_reference(state, wall_is_known=False)
        sums = OffsetSums(state, moved, wall, own)
        for count, _ in enumerate(sums.read(), 1):
            if count in FRAMES:
                value, half_width, _ = sums.estimate()
                ends = value - half_width, value + half_width
                lines.append(_line(wall, count, DRIFT_MM, value, ends))
    return [{"draw": number, "model": model, **line} for line in lines]


def recorded(later: Values, folder: Path, frames: int, drift: float) -> Dataset:
    """Simulate the frames to check."""
    values = json.loads(json.dumps(later))
    values["shots"][0]["poses"] = frames
    values["sensor"]["delays"]["constant_mm"] += drift
    simulate(SimulatorOptions.from_mapping(values, "drawn"), folder)
    return Dataset((Recording.open(folder),))


def _line(wall: Wall, frames: int, drift_mm: float, offset: float, interval: Limits) -> Values:
    """Return what was found with a wall and a number of frames; offset and interval in metres."""
    low, high = (1e3 * end for end in interval)
    return {
        "frames": frames,
        "wall": wall,
        "drift_mm": drift_mm,
        "offset_mm": 1e3 * offset,
        "interval_mm": [low, high],
        "covered": low <= drift_mm <= high,
        "differs_from_0": low > 0 or high < 0,
    }


def summary(lines: Sequence[Values]) -> str:
    """Return coverage and power by wall and number of frames."""
    head = ("wall", "frames", "draws, unchanged", "coverage of 0", "half width, median mm")
    head += ("RMS error, mm", "said `drifted`", "headlines", "draws, drifted")
    head += (f"coverage of {DRIFT_MM:g} mm", f"{DRIFT_MM:g} mm told from 0")
    rows = []
    for wall, frames in itertools.product(WALLS, (None, *FRAMES)):
        own = [one for one in lines if one["wall"] == wall and frames in (None, one["frames"])]
        same = [one for one in own if not one["drift_mm"]]
        moved = [one for one in own if one["drift_mm"]]
        if not same or not moved:
            continue
        half = np.median([np.diff(one["interval_mm"])[0] / 2 for one in same])
        error = math.sqrt(float(np.mean([one["offset_mm"] ** 2 for one in same])))
        drifts = sum(one["verdict"] == "drifted" for one in same)
        headlines = sum(one["headline"] is not None for one in same)
        held = share(one["covered"] for one in same)
        cells = (len(same), held, f"{half:.2f}", f"{error:.2f}", drifts, headlines)
        of_drifted: list[object] = ["", "", ""]
        if frames is not None:  # All numbers of frames together are not independent.
            shares = (share(one[key] for one in moved) for key in ("covered", "differs_from_0"))
            of_drifted = [len(moved), *shares]
        rows.append((wall, frames or "all", *cells, *of_drifted))
    return table(head, rows)


@click.command()
@click.option("--count", default=200, show_default=True, help="Cameras drawn.")
@click.option("--seed", default=0, show_default=True)
@click.option("--out", type=click.Path(path_type=Path), help="JSON file for every check.")
def main(count: int, seed: int, out: Path | None) -> None:
    """Measure coverage and power of the check's intervals."""
    torch.set_num_threads(1)
    lines: list[Values] = []
    left_out = []
    for number in tqdm(range(count), desc="cameras", disable=None):
        with tempfile.TemporaryDirectory() as folder:
            try:
                lines += one_draw(number, seed, Path(folder))
            except TofcorrError as error:
                left_out.append(f"draw {number}: {error}")
    click.echo(summary(lines))
    click.echo("\n".join([f"Draws left out: {len(left_out)}.", *left_out]))
    write(lines, out)


if __name__ == "__main__":
    main()
