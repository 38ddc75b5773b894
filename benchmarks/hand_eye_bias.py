"""Do hand-eye intervals hold the truth where the form of an error is wrong and depth is noisy?

    python -m benchmarks.hand_eye_bias --seed S --count 80

Recordings of the renewed generator with nothing missing: its cameras, robots and masks, errors of
distance, pixel and amplitude that no polynomial is, small images. EA is fitted to each. Components
are in camera axes; z is the viewing direction. Two estimates are compared: that of the least loss,
with the scatter of poses as its interval and with the noise's whole shift beside it; and that which
the shift was taken off, with its own interval.
"""

import tempfile
from pathlib import Path
from typing import NamedTuple

import click
import numpy as np
import torch
from tqdm import tqdm

from benchmarks.levels import small_images
from benchmarks.renewed.recording import record, write_recording
from benchmarks.renewed.world import draw_world
from benchmarks.sealed.scores import share, table
from tofcorr.data.recording import Recording
from tofcorr.estimation.moments import Parameters
from tofcorr.estimation.robust import student_quantile
from tofcorr.fit.fitting import fit
from tofcorr.fit.noise_shift import NoiseShift
from tofcorr.geometry import se3
from tofcorr.options import resolve_options
from tofcorr.pixels.dataset import Dataset, covered_domain
from tofcorr.training.options import TrainingOptions

AXES = ("x", "y", "z", "turn x", "turn y", "turn z")


class Found(NamedTuple):
    """Errors, half-widths and the noise's shift of one recording, (6,) each, metres and radians."""

    at_least_loss: np.ndarray
    error: np.ndarray
    by_scatter: np.ndarray
    with_shift: np.ndarray
    stated: np.ndarray
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
    true = torch.as_tensor(world.tool_from_camera)
    quantile = student_quantile(0.975, found.covariance.degrees_of_freedom)
    shift = found.noise_shift or NoiseShift(torch.zeros(6).double(), removed=False)
    scatter = found.covariance.matrix[:6, :6]
    by_scatter, with_shift, stated = (
        quantile * matrix.diagonal().clamp(min=0).sqrt().numpy()
        for matrix in (
            scatter,
            scatter + torch.outer(shift.twist, shift.twist),
            found.hand_eye_covariance,
        )
    )
    return Found(
        at_least_loss=_error(true, found.optimum),
        error=_error(true, found.solution.parameters),
        by_scatter=by_scatter,
        with_shift=with_shift,
        stated=stated,
        shift=shift.twist.numpy(),
    )


def _error(true: torch.Tensor, found: Parameters) -> np.ndarray:
    """Return the error of a hand-eye transform in camera axes, (6,), metres and radians."""
    best = found.tool_from_camera
    turn = se3.log(se3.assemble(true[:3, :3].T @ best[:3, :3], torch.zeros(3).double()))[3:]
    return torch.cat([true[:3, :3].T @ (best - true)[:3, 3], turn]).numpy()


def tables(rows: list[Found]) -> str:
    """Return coverage of each component, and how much of the error along z the noise makes."""
    least, error, *halves, shift = (np.stack(part) for part in zip(*rows, strict=True))
    names = ("least loss, scatter of poses", "least loss, and the shift", "shift taken off")
    lines = []
    for name, off, half in zip(names, (least, least, error), halves, strict=True):
        held = np.abs(off) <= half
        counted = [share(column) for column in (*held.T, held.ravel())]
        texts = ["{:.2f} [{:.2f}, {:.2f}]".format(one.value, *one.interval) for one in counted]
        lines.append((name, len(rows), *texts))
    before, after = 1e3 * least[:, 2], 1e3 * error[:, 2]
    alike = np.corrcoef(before, 1e3 * shift[:, 2])[0, 1]
    wider = [np.median(half[:, 2] / halves[0][:, 2]) for half in halves[1:]]
    return (
        f"{table(('95 % intervals by', 'n', *AXES, 'all'), lines)}\n\n"
        f"z: the noise's shift and the error correlate by {alike:.2f}; median error "
        f"{np.median(np.abs(before)):.2f} mm at the least loss, {np.median(np.abs(after)):.2f} mm "
        f"with the shift taken off; root mean square {_rms(before):.1f} and {_rms(after):.1f} mm; "
        f"intervals {wider[0]:.2f} and {wider[1]:.2f} times those of the scatter (median)"
    )


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


@click.command(context_settings={"help_option_names": ["-h", "--help"]})
@click.option("--seed", type=int, required=True)
@click.option("--count", default=80, show_default=True)
def main(seed: int, count: int) -> None:
    """Measure the coverage of hand-eye intervals."""
    torch.set_num_threads(1)
    click.echo(tables([one_recording(seed, number) for number in tqdm(range(count), leave=False)]))


if __name__ == "__main__":
    main()
