"""What is gained and lost where the estimate is moved back by what the noise has moved it.

    python -m benchmarks.noise_shift --seed S --count 16

Recordings of the shipped simulations, some with a tenth of the light, fewer poses or a narrow range
of distances. Half of the poses are fitted (EA; long_range: periodic). The estimate of the least
loss is compared with the one moved: error of the hand-eye transform along the view, held-out error,
and held-out error on other poses without noise.
"""

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import click
import numpy as np
import torch
import yaml
from tqdm import tqdm

from benchmarks.renewed.tables import table
from tofcorr.correction.model import CalibrationModel
from tofcorr.data.recording import Recording
from tofcorr.error_terms.model import ErrorModel
from tofcorr.fit.assemble import calibrated
from tofcorr.fit.fitting import fit
from tofcorr.fit.result import Fit
from tofcorr.options import resolve_options
from tofcorr.pixels.dataset import Dataset
from tofcorr.pixels.domain import covered_domain
from tofcorr.pixels.metrics import frame_errors
from tofcorr.pixels.split import split_frames
from tofcorr.simulation.options import SimulatorOptions
from tofcorr.simulation.simulator import simulate
from tofcorr.training.options import TrainingOptions

_CONFIGS = Path(__file__).resolve().parents[1] / "configs" / "simulate"


class Design(NamedTuple):
    """A shipped simulation with changes.

    Attributes:
        light: Factor of the electrons.
        poses: Factor of the number of poses.
        distance: Nearest and farthest distance, metres; empty: as in the configuration.
        model: The configuration fitted.
    """

    config: str
    light: float = 1.0
    poses: float = 1.0
    distance: tuple[float, ...] = ()
    model: str = "ea"


DESIGNS = {
    "set1": Design("set1"),
    "set2 (white, small tilts)": Design("set2"),
    "set3": Design("set3"),
    "demo": Design("demo"),
    "long_range": Design("long_range", model="periodic"),
    "demo, dim": Design("demo", light=0.1),
    "demo, dim, 0.9 to 1.2 m": Design("demo", light=0.1, distance=(0.9, 1.2)),
    "demo, dim, a third of the poses": Design("demo", light=0.1, poses=1 / 3),
    "set2, dim": Design("set2", light=0.1),
}


class Found(NamedTuple):
    """Of one recording, at the least loss and moved, (2,) each, millimetres."""

    along_view: np.ndarray
    held_out: np.ndarray
    without_noise: np.ndarray


def options_of(design: Design) -> SimulatorOptions:
    """Return the simulation of a design; amplitudes in counts stay as they are."""
    given: dict[str, Any] = yaml.safe_load((_CONFIGS / f"{design.config}.yaml").read_text())
    sensor, share = given["sensor"], design.light
    sensor["light"]["electrons_at_1m"] *= share
    sensor["readout"]["electrons_per_count"] *= share
    sensor["readout"]["read_noise_electrons"] *= share**0.5
    sensor["delays"]["amplitude"]["electrons"] *= share
    for shot in given["shots"]:
        shot["poses"] = round(shot["poses"] * design.poses)
    if design.distance:
        given["robot"]["distance_m"] = list(design.distance)
    return resolve_options(SimulatorOptions, given)


def one_recording(design: Design, seed: Sequence[int]) -> Found:
    """Simulate, fit and measure one recording, and measure on another without noise."""
    simulation, training = options_of(design), resolve_options(TrainingOptions, design.model)
    noisy, clean = (int(one) for one in np.random.SeedSequence(seed).generate_state(2))
    with tempfile.TemporaryDirectory() as folder:
        paths = Path(folder) / "noisy", Path(folder) / "clean"
        simulate(simulation, paths[0], torch.Generator().manual_seed(noisy))
        simulate(simulation, paths[1], torch.Generator().manual_seed(clean), noise=False)
        data, other = (Dataset((Recording.open(path),)) for path in paths)
        train, test = split_frames(data, training.split)
        found = fit(data, train, training, covered_domain(data, train))
        models = {"least loss": at_least_loss(found), "moved": found.model}
        errors, without = frame_errors(data, models, test), frame_errors(other, models)
    true = simulation.hand_eye.tool_from_camera()
    off = [
        float(true[:3, 2] @ (model.hand_eye().detach() - true)[:3, 3]) for model in models.values()
    ]
    return Found(
        along_view=1e3 * np.array(off),
        held_out=np.array([errors[name].rms_mm() for name in models]),
        without_noise=np.array([without[name].rms_mm() for name in models]),
    )


def at_least_loss(found: Fit) -> CalibrationModel:
    """Return the model of the least loss."""
    error = ErrorModel(found.options, found.domain)
    error.set_coefficient_vector(found.optimum.coefficients)
    return calibrated(error, found.optimum)


def row(name: str, found: list[Found]) -> tuple[object, ...]:
    """Return root mean squares of the hand-eye's error, and mean errors with their change."""
    along, held_out, without = (np.stack(part) for part in zip(*found, strict=True))
    cells = [_arrow(np.sqrt(np.mean(along**2, axis=0)))]
    for one in (held_out, without):
        change = one[:, 1] - one[:, 0]
        error = change.std(ddof=1) / len(change) ** 0.5
        cells += [_arrow(one.mean(axis=0)), f"{change.mean():+.3f} ± {error:.3f}"]
        cells.append(f"{change.max():+.2f}")
    return (name, len(found), *cells)


def _arrow(pair: np.ndarray) -> str:
    return f"{pair[0]:.3g} → {pair[1]:.3g}"


@click.command(context_settings={"help_option_names": ["-h", "--help"]})
@click.option("--seed", type=int, required=True)
@click.option("--count", default=16, show_default=True, help="Recordings of each design.")
def main(seed: int, count: int) -> None:
    """Compare the estimate of the least loss with the one moved, mm."""
    torch.set_num_threads(1)
    rows = [
        row(name, [one_recording(design, (seed, number, k)) for k in range(count)])
        for number, (name, design) in enumerate(tqdm(DESIGNS.items(), leave=False))
    ]
    change = ("change ± SE", "worst")
    head = ("design", "n", "along the view", "held out", *change, "without noise", *change)
    click.echo(table(head, rows))


if __name__ == "__main__":
    main()
