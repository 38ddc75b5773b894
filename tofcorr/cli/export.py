"""`tofcorr export`: write the calibration of a run in another format."""

import json
from pathlib import Path

import click

from tofcorr.correction.export.registry import FORMATS
from tofcorr.files.arguments import ReplacedFile


@click.command()
@click.option(
    "--run",
    required=True,
    type=click.Path(path_type=Path),
    help="Folder that tofcorr train made.",
)
@click.option(
    "--format",
    "name",
    required=True,
    type=click.Choice(list(FORMATS)),
    help=" ".join(f"{one.name} ({one.ending}): {one.summary}." for one in FORMATS.values()),
)
@click.option(
    "--out",
    required=True,
    type=ReplacedFile(),
    help="File to write; an older one is replaced.",
)
@click.option(
    "--device", default="cpu", show_default=True, help="What pt2 is compiled for: cpu or cuda."
)
def command(run: Path, name: str, out: Path, device: str) -> None:
    """Write the corrector of a run, or the camera's pose, once it agrees with the calibration.

    Nothing is written when it does not, nor of a run whose verdict is `do not use`, unless it was
    trained with --force.
    """
    import torch

    from tofcorr.correction.corrector import DepthCorrector
    from tofcorr.correction.export import export
    from tofcorr.correction.state import STATE_FILE, load_calibration
    from tofcorr.errors import ConfigError

    if device != "cpu" and not (FORMATS[name].for_device and torch.cuda.is_available()):
        compiled = " and ".join(one.name for one in FORMATS.values() if one.for_device)
        raise ConfigError(
            f"--device {device}: only {compiled} is compiled for a device, and only for a GPU that "
            "this machine has; the other formats run on any."
        )
    _refuse_useless(run)
    state = load_calibration(run / STATE_FILE)
    export(name, DepthCorrector.from_state(state).to(device), out, state)
    click.echo(f"{out}: the calibration {state.name} of {run} as {name}, checked after writing.")


def _refuse_useless(run: Path) -> None:
    """Refuse a run that `tofcorr train` gave no corrector.ts, for the reason in its report."""
    from tofcorr.errors import CalibrationDataError
    from tofcorr.training.verdict import DO_NOT_USE

    file = run / "report.json"
    if (run / "corrector.ts").exists() or not file.exists():
        return
    report = json.loads(file.read_text(encoding="utf-8"))
    if report["verdict"] == DO_NOT_USE:
        raise CalibrationDataError(
            f"{run}: its verdict is `{DO_NOT_USE}`: {report['reason']} Train with --force to "
            "export it all the same."
        )
