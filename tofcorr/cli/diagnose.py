"""`tofcorr diagnose`: where simulator and recording differ, and which effect is missing."""

from contextlib import nullcontext
from pathlib import Path

import click

from tofcorr.cli.memory import keep_freed_memory, memory_beforehand
from tofcorr.cli.shared_options import config_options, force_option

# Memory that the sums of a recording take, bytes for each pixel of its depth, and at most.
# Measured: 270 columns of float64 and half as much again, of the 200,000 pixels used at most.
_BYTES_A_PIXEL, _MOST_BYTES = 3_300, 660_000_000


@click.command()
@click.option(
    "--recording",
    "recording_path",
    required=True,
    type=click.Path(path_type=Path),
    help="Folder of the real recording.",
)
@click.option(
    "--sim",
    "simulator",
    help="Simulator under diagnosis: YAML file or shipped name of the built-in one, or a recording "
    "that any other one rendered; without it a simulator is fitted to the recording.",
)
@config_options(
    "diagnose", "Base model, tests and catalogue", "tests.level=0.01", default="default"
)
@click.option(
    "--out", required=True, type=click.Path(path_type=Path), help="Folder of the report, made anew."
)
@force_option
def command(
    recording_path: Path,
    simulator: str | None,
    config: str,
    changes: tuple[str, ...],
    out: Path,
    force: bool,
) -> None:
    """Find the effect that a simulator lacks.

    The report folder holds report.html for people, diagnosis.json for programs, the simulator with
    the effects added (simulator_with_effects.yaml, which `tofcorr simulate` runs), the camera as
    it was found (sensor.yaml, which `tofcorr degrade` takes) and the numbers for TensorBoard.
    """
    kept = keep_freed_memory()
    with memory_beforehand(_needed(recording_path)) if kept else nullcontext():
        from tofcorr.diagnosis.diagnose import diagnose
        from tofcorr.diagnosis.options import DiagnosisOptions
        from tofcorr.options import resolve_options

    options = resolve_options(DiagnosisOptions, config, changes)
    found = diagnose(recording_path, simulator, options, out=out, force=force, may_copy=True)
    click.echo(repr(found))
    click.echo(f"Report filed in {out}")


def _needed(recording: Path) -> int:
    """Return how many bytes the sums of a recording will take; little for one that is none."""
    try:
        pixels = (recording / "depth.npy").stat().st_size // 4
    except OSError:
        pixels = 0
    return min(_BYTES_A_PIXEL * pixels, _MOST_BYTES)
