"""`tofcorr check`: does a calibration still hold?"""

from pathlib import Path
from typing import Literal

import click

from tofcorr.cli.shared_options import force_option, recordings_option
from tofcorr.files.arguments import ReplacedFile


@click.command()
@click.option(
    "--run", required=True, type=click.Path(path_type=Path), help="Folder of the training's run."
)
@recordings_option("A few frames of any wall.")
@click.option(
    "--wall",
    type=click.Choice(["per_image", "one", "recorded"]),
    default="per_image",
    show_default=True,
    help="What is known of the wall: nothing; that all frames show the same one and the robot's "
    "poses are right; or its recorded plane.",
)
@click.option(
    "--threshold-mm",
    type=float,
    default=5.0,
    show_default=True,
    help="Offset or departure from a plane above which the camera counts as drifted.",
)
@click.option("--out", type=ReplacedFile(), help="JSON file to write.")
@force_option
def command(
    run: Path,
    recordings: tuple[Path, ...],
    wall: Literal["per_image", "one", "recorded"],
    threshold_mm: float,
    out: Path | None,
    force: bool,
) -> None:
    """Measure a calibration again on a few frames and say how far the camera has drifted.

    The answer is `holds`, `drifted` or `undecided`; the exit code is 0 in each case.
    """
    from tofcorr.drift.check import check

    click.echo(
        repr(check(run, recordings, wall=wall, threshold_mm=threshold_mm, out=out, force=force))
    )
