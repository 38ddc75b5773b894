"""Do hand-eye intervals hold the truth where the model lacks an error, and does `train` say so?

    python -m benchmarks.lacking --seed S --count 10

The shipped simulation `demo` with one error that EA lacks, and shipped simulations with nothing
missing. A recording is outside if a component of its hand-eye translation leaves its 95 % interval:
without what `misfit` adds to it, and with it.
"""

import tempfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import click
import torch
import yaml
from tqdm import tqdm

import tofcorr
from benchmarks.renewed.tables import table
from tofcorr.options import resolve_options
from tofcorr.simulation.options import SimulatorOptions
from tofcorr.training.options import TrainingOptions
from tofcorr.training.uncertainty import hand_eye_intervals

LACKING: dict[str, Mapping[str, Any]] = {
    "angle of incidence, 10 mm at 48 deg": {"name": "incidence_angle", "secant": 0.02},
    "the same, negative": {"name": "incidence_angle", "secant": -0.02},
    "gloss, 15 mm": {"name": "gloss", "lobe_16deg": -0.015},
    "light of the mount, 3 %": {"name": "multipath", "flange": 0.03},
    "focal length, 1.5 %": {"name": "lens", "focal_x": 0.015, "focal_y": 0.015},
    "radial distortion, 0.03": {"name": "lens", "radial_2": 0.03},
    "wedge, 0.01": {"name": "lens", "prism_x": 0.01},
    "bent target, 10 mm": {"name": "target_shape", "x2_y0": 0.01},
    "warm-up, 15 mm": {"name": "warm_up", "rise_600s": 0.015},
    "robot's lengths, 1 %": {"name": "robot_kinematics", "length": 0.01},
}
NOTHING_MISSING = ("demo", "set1", "set2", "set3", "repeats", "coverage")


class Judged(NamedTuple):
    """One recording: millimetres, and whether a component leaves the interval."""

    error: float
    outside_before: bool
    outside: bool
    misfit: bool
    verdict: str


def judged(seed: int, config: str, effects: tuple[Mapping[str, Any], ...]) -> Judged:
    """Simulate and train one recording."""
    options = resolve_options(SimulatorOptions, config)
    options = options.model_copy(update={"seed": seed, "effects": effects})
    training = resolve_options(TrainingOptions, "ea").model_copy(update={"advice": 0})
    with tempfile.TemporaryDirectory() as folder:
        recording = tofcorr.simulate(options, Path(folder) / "recording")
        truth = yaml.safe_load((recording.path / "truth" / "truth.yaml").read_text())
        result = tofcorr.train(recording, training, force=True)
    fit = result.fit
    off = (fit.solution.parameters.tool_from_camera - torch.tensor(truth["tool_from_camera"]))[
        :3, 3
    ]
    before, after = (hand_eye_intervals(one)[0] for one in (replace(fit, misfit=None), fit))
    return Judged(
        error=1e3 * float(off.norm()),
        outside_before=bool((off.abs() > before).any()),
        outside=bool((off.abs() > after).any()),
        misfit=fit.misfit is not None,
        verdict=result.report["verdict"],
    )


def row(name: str, found: list[Judged]) -> tuple[str, ...]:
    """Return the line of one case."""
    errors = sorted(one.error for one in found)
    counts = (
        sum(one.outside_before for one in found),
        sum(one.outside for one in found),
        sum(one.misfit for one in found),
        sum(one.verdict == "good" for one in found),
    )
    typical = f"{errors[len(errors) // 2]:.1f} ({errors[0]:.1f} to {errors[-1]:.1f})"
    return (name, typical, *(f"{count} of {len(found)}" for count in counts))


@click.command(context_settings={"help_option_names": ["-h", "--help"]})
@click.option("--seed", type=int, required=True)
@click.option("--count", default=10, show_default=True)
def main(seed: int, count: int) -> None:
    """Count intervals that miss the truth, and doubts."""
    torch.set_num_threads(1)
    cases = {name: ("demo", (effect,)) for name, effect in LACKING.items()}
    cases |= {f"nothing ({config})": (config, ()) for config in NOTHING_MISSING}
    rows = [
        row(name, [judged(seed + k, *case) for k in range(count)])
        for name, case in tqdm(cases.items(), leave=False)
    ]
    heads = ("missing", "error, mm", "outside without", "outside", "misfit named", "`good`")
    click.echo(table(heads, rows))


if __name__ == "__main__":
    main()
