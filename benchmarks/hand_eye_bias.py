"""Do hand-eye intervals hold the truth where the form of an error is wrong and depth is noisy?

    python -m benchmarks.hand_eye_bias --seed S --count 80

Recordings of the renewed generator with nothing missing: its cameras, robots and masks, errors of
distance, pixel and amplitude that no polynomial is, small images. EA is fitted to each. Components
are in camera axes; z is the viewing direction. Two estimates are compared: that of the least loss,
with the scatter of poses as its interval and with the noise's whole shift beside it; and that which
the shift was taken off, with its own interval.
"""

import math
import tempfile
from pathlib import Path

import click
import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from benchmarks.levels import small_images
from benchmarks.renewed.recording import record, write_recording
from benchmarks.renewed.world import draw_world
from benchmarks.sealed.scores import share, table
from tofcorr.data.recording import Recording
from tofcorr.estimation.robust import student_quantile
from tofcorr.fit.fitting import fit
from tofcorr.geometry import se3
from tofcorr.options import resolve_options
from tofcorr.pixels.dataset import Dataset
from tofcorr.pixels.lattice import covered_domain
from tofcorr.training.calibration import TrainingOptions

AXES = ("x", "y", "z", "turn x", "turn y", "turn z")


def one_recording(seed: int, number: int) -> np.ndarray:
    """Draw and fit one recording, see `measured`."""
    rng = np.random.default_rng([seed, 1, number])
    with small_images("nothing"), tempfile.TemporaryDirectory() as folder:
        world = draw_world(rng, None)
        write_recording(Path(folder) / "recording", record(rng, world, [])[0])
        options = resolve_options(TrainingOptions, "ea")
        return measured(Path(folder) / "recording", options, world.tool_from_camera)


def measured(recording: Path, options: TrainingOptions, tool_from_camera: np.ndarray) -> np.ndarray:
    """Fit all frames of a recording, and compare with the true hand-eye transform.

    Returns:
        (6, 6), metres and radians of each component: error at the least loss; error with the shift
        taken off; half-widths by the scatter of poses, by that and the shift, and as stated; and
        the noise's shift.
    """
    data, true = Dataset((Recording.open(recording),)), torch.as_tensor(tool_from_camera)
    frames = np.arange(data.num_frames)
    found = fit(data, frames, options, covered_domain(data, frames))
    quantile = student_quantile(0.975, found.covariance.degrees_of_freedom)
    shift = found.noise_shift.twist if found.noise_shift else torch.zeros(6).double()
    scatter = found.covariance.matrix[:6, :6]
    errors = [
        hand_eye_error(true, one.tool_from_camera).flatten()
        for one in (found.optimum, found.solution.parameters)
    ]
    half_widths = [
        quantile * matrix.diagonal().clamp(min=0).sqrt()
        for matrix in (scatter, scatter + torch.outer(shift, shift), found.hand_eye_covariance)
    ]
    return torch.stack([*errors, *half_widths, shift]).numpy()


def hand_eye_error(true: Tensor, found: Tensor) -> Tensor:
    """Return place and turn (2, 3) of a hand-eye transform off the true one, in camera axes."""
    turn = se3.log(se3.assemble(true[:3, :3].T @ found[:3, :3], torch.zeros(3).double()))[3:]
    return torch.stack([true[:3, :3].T @ (found - true)[:3, 3], turn])


def tables(rows: list[np.ndarray]) -> str:
    """Return coverage of each component, and how much of the error along z the noise makes."""
    least, error, *halves, shift = np.stack(rows, axis=1)
    names = ("least loss, scatter of poses", "least loss, and the shift", "shift taken off")
    lines = []
    for name, off, half in zip(names, (least, least, error), halves, strict=True):
        held = np.abs(off) <= half
        counted = [share(column) for column in (*held.T, held.ravel())]
        texts = ["{:.2f} [{:.2f}, {:.2f}]".format(one.value, *one.interval) for one in counted]
        lines.append((name, len(rows), *texts))
    before, after = 1e3 * least[:, 2], 1e3 * error[:, 2]
    alike = np.corrcoef(before, 1e3 * shift[:, 2])[0, 1]
    rms = [math.sqrt(np.mean(one**2)) for one in (before, after)]
    wider = [np.median(half[:, 2] / halves[0][:, 2]) for half in halves[1:]]
    return (
        f"{table(('95 % intervals by', 'n', *AXES, 'all'), lines)}\n\n"
        f"z: the noise's shift and the error correlate by {alike:.2f}; median error "
        f"{np.median(np.abs(before)):.2f} mm at the least loss, {np.median(np.abs(after)):.2f} mm "
        f"with the shift taken off; root mean square {rms[0]:.1f} and {rms[1]:.1f} mm; "
        f"intervals {wider[0]:.2f} and {wider[1]:.2f} times those of the scatter (median)"
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
