"""Do hand-eye intervals hold the truth where the form of an error is wrong and depth is noisy?

    python -m benchmarks.hand_eye_bias --seed S --count 80

Recordings of the renewed generator with nothing missing: its cameras, robots and masks, errors of
distance, pixel and amplitude that no polynomial is, small images. EA is fitted to each. Components
are in camera axes; z is the viewing direction. Two intervals are compared: by the scatter of poses
alone, and with what the noise of the distances moves.
"""

import tempfile
from pathlib import Path
from typing import NamedTuple

import click
import numpy as np
import torch
from tqdm import tqdm

from benchmarks.levels.cases import small_images
from benchmarks.renewed.generator.recording import record
from benchmarks.renewed.generator.world import draw_world
from benchmarks.renewed.generator.writing import write_recording
from benchmarks.renewed.tables import table
from benchmarks.withheld.statistics import share
from tofcorr.data.recording import Recording
from tofcorr.estimation.student import student_quantile
from tofcorr.fit.fitting import fit
from tofcorr.fit.noise_shift import with_noise
from tofcorr.geometry import se3
from tofcorr.options import resolve_options
from tofcorr.pixels.dataset import Dataset
from tofcorr.pixels.domain import covered_domain
from tofcorr.training.options import TrainingOptions

AXES = ("x", "y", "z", "turn x", "turn y", "turn z")


class Found(NamedTuple):
    """Error, half-widths and the noise's shift of one recording, (6,) each, metres and radians."""

    error: np.ndarray
    by_scatter: np.ndarray
    with_shift: np.ndarray
    shift: np.ndarray


def one_recording(seed: int, number: int) -> Found:
    """Draw and fit one recording."""
    rng = np.random.default_rng([seed, 1, number])
    with small_images("nothing"), tempfile.TemporaryDirectory() as folder:
        world = draw_world(rng, None)
        write_recording(Path(folder) / "recording", record(rng, world, [])[0])
        data = Dataset((Recording.open(Path(folder) / "recording"),))
        frames, options = np.arange(data.num_frames), resolve_options(TrainingOptions, "ea")
        found = fit(data, frames, options, covered_domain(data, frames))
        found = with_noise(found, data, frames)
    true, best = torch.as_tensor(world.tool_from_camera), found.solution.parameters.tool_from_camera
    turn = se3.log(se3.assemble(true[:3, :3].T @ best[:3, :3], torch.zeros(3).double()))[3:]
    error = torch.cat([true[:3, :3].T @ (best - true)[:3, 3], turn])
    quantile = student_quantile(0.975, found.covariance.degrees_of_freedom)
    widths = [
        quantile * matrix.diagonal().clamp(min=0).sqrt().numpy()
        for matrix in (found.covariance.matrix[:6, :6], found.hand_eye_covariance)
    ]
    shift = torch.zeros(6) if found.noise_shift is None else found.noise_shift
    return Found(error.numpy(), widths[0], widths[1], shift.numpy())


def tables(rows: list[Found]) -> str:
    """Return coverage of each component, and how much of the error along z the noise makes."""
    error, by_scatter, with_shift, shift = (np.stack(part) for part in zip(*rows, strict=True))
    lines = []
    for name, half in (("scatter of poses", by_scatter), ("and the noise", with_shift)):
        held = np.abs(error) <= half
        counted = [share(column) for column in (*held.T, held.ravel())]
        texts = ["{:.2f} [{:.2f}, {:.2f}]".format(one.value, *one.interval) for one in counted]
        lines.append((name, len(rows), *texts))
    along, moved = 1e3 * error[:, 2], 1e3 * shift[:, 2]
    alike, wider = np.corrcoef(along, moved)[0, 1], np.median(with_shift[:, 2] / by_scatter[:, 2])
    before, after = np.median(np.abs(along)), np.median(np.abs(along - moved))
    return (
        f"{table(('95 % intervals by', 'n', *AXES, 'all'), lines)}\n\n"
        f"z: the noise's shift and the error correlate by {alike:.2f}; median error {before:.2f} "
        f"mm, less the shift {after:.2f} mm; intervals {wider:.2f} times as wide (median)"
    )


@click.command(context_settings={"help_option_names": ["-h", "--help"]})
@click.option("--seed", type=int, required=True)
@click.option("--count", default=80, show_default=True)
def main(seed: int, count: int) -> None:
    """Measure the coverage of hand-eye intervals."""
    torch.set_num_threads(1)
    click.echo(tables([one_recording(seed, number) for number in tqdm(range(count), leave=False)]))


if __name__ == "__main__":
    main()
