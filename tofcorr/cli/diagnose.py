"""`tofcorr diagnose`: where simulator and recording differ, and which effect is missing."""

from pathlib import Path

import click

from tofcorr.cli.shared_options import config_options, force_option
from tofcorr.files.arguments import NewPath


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
@click.option("--out", required=True, type=NewPath(), help="Folder of the report, made anew.")
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
    from tofcorr.diagnosis.diagnose import diagnose
    from tofcorr.diagnosis.options import DiagnosisOptions
    from tofcorr.options import resolve_options

    options = resolve_options(DiagnosisOptions, config, changes)
    found = diagnose(recording_path, simulator, options, out=out, force=force)
    click.echo(repr(found))
    click.echo(f"Report filed in {out}")
