"""`tofcorr diagnose`: where simulator and recording part, and which effect is missing."""

from pathlib import Path

import click

from tofcorr.cli.config_option import config_options


@click.command(name="diagnose", short_help="Say where simulator and recording part, and why.")
@click.option(
    "--recording",
    "recording_path",
    required=True,
    type=click.Path(path_type=Path),
    help="Folder of the real recording.",
)
@click.option(
    "--sim",
    "simulator_path",
    type=click.Path(path_type=Path),
    help="YAML file of the simulator under diagnosis; without it one is fitted to the recording.",
)
@config_options("diagnose", "Base model, tests and catalogue", default="default")
@click.option(
    "--out", required=True, type=click.Path(path_type=Path), help="Folder of the report, made anew."
)
def command(
    recording_path: Path,
    simulator_path: Path | None,
    config: str,
    changes: tuple[str, ...],
    out: Path,
) -> None:
    """Find the effect that a simulator lacks.

    The report folder holds report.html for people, diagnosis.json for programs, the simulator with
    the effects added (simulator_with_effects.yaml, which `tofcorr simulate` runs) and figures
    for TensorBoard.
    """
    from tofcorr.data.recording import Recording
    from tofcorr.diagnosis.diagnose import diagnose
    from tofcorr.diagnosis.options import DiagnosisOptions
    from tofcorr.diagnosis.report.write import write_report
    from tofcorr.options import load_options, resolve_options
    from tofcorr.simulation.options import SimulatorOptions

    options = resolve_options(DiagnosisOptions, config, changes)
    simulator = load_options(SimulatorOptions, simulator_path) if simulator_path else None
    recording = Recording.open(recording_path)
    diagnosis = diagnose(recording, options, simulator)
    write_report(diagnosis, out, simulator)
    click.echo(diagnosis.verdict)
    for warning in diagnosis.warnings:
        click.echo(f"Warning: {warning}")
    click.echo(f"Report filed in {out}")
