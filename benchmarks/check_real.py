"""Do the intervals of `tofcorr check` hold zero for frames of one real camera?

    python -m benchmarks.check_real RECORDING --splits 20 --seed 0

Every split trains on some frames of the recording and checks others, in groups of 3, 8 and 20: the
camera is the same, so every interval should hold zero. *Random*: 40 % of the frames, drawn, are
checked in random order. *Consecutive*: 20 frames in a row are checked, and those next to them left
out of the training, so that the views checked lie between or beyond those trained on. Splits share
frames; shares therefore have no interval.
"""

import math
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import click
import numpy as np
import torch

from tofcorr.correction.state import CalibrationState
from tofcorr.data.recording import Recording
from tofcorr.data.writing import write_recording
from tofcorr.drift.corrected_images import PixelCount, Wall, corrected_images
from tofcorr.drift.offset import Offset, OffsetSums
from tofcorr.fit.reference.reference import Reference
from tofcorr.fit.reference.views import share_unlike, view_of
from tofcorr.options import resolve_options
from tofcorr.pixels.dataset import Dataset
from tofcorr.progress import through
from tofcorr.training.options import TrainingOptions
from tofcorr.training.result import calibration_state, run_reference
from tofcorr.training.run import train

WALLS: tuple[Wall, ...] = ("per_image", "recorded")
GROUPS = (3, 8, 20)
MODELS = ("ea", "eb", "ea_log")
# Share of the frames that a random split checks; length of a run of frames, and how many on either
# side of it no training sees.
CHECKED, RUN, GAP = 0.4, 20, 2


class Found(NamedTuple):
    """One check: how the frames were chosen, what was assumed, how many frames, and what came."""

    kind: str
    wall: Wall
    frames: int
    offset: Offset
    unlike: float


def random_split(count: int, generator: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return the frames to train on and to check."""
    order = generator.permutation(count)
    checked = round(CHECKED * count)
    return np.sort(order[checked:]), order[:checked]


def consecutive_split(count: int, generator: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return the frames to train on and to check."""
    start = int(generator.integers(0, count - RUN + 1))
    near = np.arange(start - GAP, start + RUN + GAP)
    return np.setdiff1d(np.arange(count), near), np.arange(start, start + RUN)


SPLITS = {"random": random_split, "consecutive": consecutive_split}


def some_frames(recording: Recording, frames: np.ndarray, folder: Path) -> Dataset:
    """Write some frames of a recording as one of its own."""
    assert recording.amplitude is not None
    mask = recording.mask
    write_recording(
        folder,
        camera=recording.camera,
        depth_kind=recording.depth_kind,
        rows=recording.frames.select(frames),
        depth=recording.depth[frames],
        amplitude=recording.amplitude[frames],
        mask=None if mask is None else mask[frames],
        saturation_amplitude=recording.saturation_amplitude,
    )
    return Dataset((Recording.open(folder, check_contents=False),))


def trained(data: Dataset, model: str) -> tuple[CalibrationState, Reference | None]:
    """Calibrate; return what a run folder would hold of it."""
    options = resolve_options(TrainingOptions, model).model_copy(update={"advice": 0})
    result = train(data.recordings, options)
    state = calibration_state(result.data, options, result.fit)
    return state, run_reference(result.calibration, state)


def checks(state: CalibrationState, reference: Reference, data: Dataset) -> Iterator[Found]:
    """Yield a check of every group of frames, one after the other, with each wall."""
    for wall in WALLS:
        images = list(corrected_images(state, data, wall, PixelCount()))
        for size in GROUPS:
            for start in range(0, len(images) - size + 1, size):
                sums = OffsetSums(reference, wall)
                checked = images[start : start + size]
                for image in checked:
                    sums.add(image)
                views = torch.stack([view_of(image.linear) for image in checked])
                assert reference.views is not None
                unlike = share_unlike(views, reference.views)
                yield Found("", wall, size, sums.estimate(), unlike)


def summary(found: Sequence[Found]) -> str:
    """Return coverage by kind of split, wall and number of frames."""
    rows = [
        "| frames chosen | wall | frames | checks | holds 0 | half width, median mm "
        "| RMS offset, mm | headlines | views said to be unlike |",
        "|---|---|---:|---:|---:|---:|---:|---:|---:|",
    ]
    for kind in SPLITS:
        for wall in WALLS:
            for size in GROUPS:
                chosen = [one for one in found if one[:3] == (kind, wall, size)]
                own = [one.offset for one in chosen]
                if not own:
                    continue
                held = np.mean([abs(one.value) <= one.half_width for one in own])
                half = 1e3 * np.median([one.half_width for one in own])
                error = 1e3 * math.sqrt(float(np.mean([one.value**2 for one in own])))
                headlines = sum(one.disagrees for one in own)
                rows.append(
                    f"| {kind} | {wall} | {size} | {len(own)} | {held:.3f} | {half:.1f} "
                    f"| {error:.1f} | {headlines} | {sum(one.unlike > 0.5 for one in chosen)} |"
                )
    return "\n".join(rows)


@click.command()
@click.argument("path", type=click.Path(path_type=Path))
@click.option("--splits", default=20, show_default=True, help="Splits of each kind.")
@click.option("--seed", default=0, show_default=True)
def main(path: Path, splits: int, seed: int) -> None:
    """Measure how often the check's intervals hold zero for one camera."""
    torch.set_num_threads(1)
    recording = Recording.open(path, check_contents=False)
    found: list[Found] = []
    for number in through(range(splits), "splits", total=splits):
        for place, (kind, split) in enumerate(SPLITS.items()):
            generator = np.random.default_rng([seed, number, place])
            fitted, checked = split(recording.num_frames, generator)
            model = str(generator.choice(MODELS))
            with tempfile.TemporaryDirectory() as folder:
                data = some_frames(recording, fitted, Path(folder) / "train")
                state, reference = trained(data, model)
                assert reference is not None
                data = some_frames(recording, checked, Path(folder) / "check")
                found += [one._replace(kind=kind) for one in checks(state, reference, data)]
    click.echo(summary(found))


if __name__ == "__main__":
    main()
