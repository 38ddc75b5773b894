"""The commands that simulate a camera, and that compare simulator and recording."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from tofcorr.cli.shared import (
    config_options,
    force_option,
    option,
    out_option,
    recording_option,
    show,
)

if TYPE_CHECKING:
    from tofcorr.diagnosis.options import DiagnosisOptions
    from tofcorr.simulation.options import SimulatorOptions

_SIMULATOR = "simulation.options:SimulatorOptions"
_DIAGNOSIS = "diagnosis.options:DiagnosisOptions"

_SENSOR = "A shipped camera such as kinect_v2, a diagnosis' report, or its sensor.yaml."
_LIGHT = "What amplitude.npy of the ideal recording holds: the camera's units, or a share 0 to 1."
_SIM = "YAML or shipped name of the built-in simulator, or a rendered recording; else: fitted."


@click.command()
@config_options(_SIMULATOR, "simulate", "Camera, scene and robot", "robot.tilt_deg=20")
@out_option("Folder of the recording, made anew.")
@option("--seed", "Instead of the seed in the file.", type=click.IntRange(min=0))
@option("--frames", "Take only so many frames.", type=click.IntRange(min=1))
def simulate_command(
    options: "SimulatorOptions", out: Path, seed: int | None, frames: int | None
) -> None:
    """Simulate a camera on a robot before a wall, and write what it records.

    What the camera cannot know (true distances, the hand-eye transform) goes to OUT/truth, which
    nothing that fits, corrects or diagnoses reads.
    """
    from tofcorr.simulation.simulator import simulate

    if seed is not None:
        options = options.model_copy(update={"seed": seed})
    simulate(options, out, num_frames=frames)
    click.echo(f"Recording written to {out}")


@click.command()
@option("--sensor", _SENSOR, required=True)
@recording_option("Folder of the ideal recording, rendered with the camera's intrinsics.")
@out_option("Folder of the degraded recording, made anew.")
@option("--seed", "Of all random draws.", default=0, type=click.IntRange(min=0))
@option(
    "--amplitude-is", _LIGHT, default="amplitude", type=click.Choice(["amplitude", "reflectivity"])
)
def degrade_command(sensor: str, recording_path: Path, out: Path, **given: Any) -> None:  # noqa: ANN401
    """Write what a real camera would have measured where an ideal one recorded.

    Depth gets the camera's error terms, effects, noise and missing pixels. Poses, planes and all
    columns stay; true_depth.npy keeps the ideal depth. Effects that no depth image can show are
    left out and listed.
    """
    import warnings

    from tofcorr.sensor.degrade import degrade

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        done = degrade(sensor, recording_path, out, **given)
    for sentence in dict.fromkeys(str(warning.message) for warning in caught):
        click.echo(f"Warning: {sentence}", err=True)
    valid = f"{done.valid_share:.1%} of the pixels with a true distance are valid"
    click.echo(f"{out}: {done.recording.num_frames} frames; {valid}.")


@click.command()
@recording_option("Folder of the real recording.")
@option("--sim", _SIM, "simulator")
@config_options(
    _DIAGNOSIS, "diagnose", "Base model, tests and catalogue", "tests.level=0.01", "default"
)
@out_option("Folder of the report, made anew.")
@force_option
def diagnose_command(
    options: "DiagnosisOptions",
    recording_path: Path,
    simulator: str | None,
    **given: Any,  # noqa: ANN401
) -> None:
    """Find the effect that a simulator lacks.

    The report folder holds report.html for people, diagnosis.json for programs, the simulator with
    the effects added (simulator_with_effects.yaml, which `tofcorr simulate` runs), the camera as
    it was found (sensor.yaml, which `tofcorr degrade` takes) and the numbers for TensorBoard.
    """
    from tofcorr.diagnosis.diagnose import diagnose

    show(diagnose(recording_path, simulator, options, **given), given["out"])
