"""`tofcorr inspect`: what is odd about a recording."""

from pathlib import Path
from typing import Literal

import click

from tofcorr.files.arguments import NewPath


@click.command()
@click.argument("recordings", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option("--out", type=NewPath(), help="HTML page with pictures to write.")
@click.option(
    "--planes",
    type=click.Choice(["auto", "known", "unknown"]),
    default="auto",
    show_default=True,
    help="Whether the recorded planes were measured (known) or are a start for the fit (unknown); "
    "auto: as recording.yaml says.",
)
def command(
    recordings: tuple[Path, ...], out: Path | None, planes: Literal["auto", "known", "unknown"]
) -> None:
    """Look at recordings as an experienced user would, and say what is odd, with numbers.

    Units, kind of depth, poses, planes, images and amplitudes are compared on a few pixels of each
    frame. A finding is `impossible` (any fit would be meaningless: every command stops there
    unless --force), `doubtful` (it heads their reports) or a `note`. The exit code is 0 in each
    case.
    """
    from tofcorr.plausibility.examine import inspect

    click.echo(repr(inspect(recordings, planes=planes, out=out)))
    if out is not None:
        click.echo(f"Page written to {out}")
