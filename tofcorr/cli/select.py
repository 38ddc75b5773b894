"""`tofcorr select`: the model that predicts best on held-out data."""

from pathlib import Path

import click

from tofcorr.cli.shared_options import config_options, force_option, recordings_option
from tofcorr.files.arguments import NewPath


@click.command()
@config_options("select", "The models and what is held out", "folds=5", default="paper")
@recordings_option("Folder of a recording; several of one camera are taken together.")
@click.option("--out", required=True, type=NewPath(), help="New folder.")
@force_option
def command(
    config: str, changes: tuple[str, ...], recordings: tuple[Path, ...], out: Path, force: bool
) -> None:
    """Compare models on images, distances and targets that they were not fitted to.

    Names the simplest model within one standard error of the best, and those that do not differ
    significantly from it. Writes selection.json and selection.md to OUT.
    """
    from tofcorr.comparison.options import SelectionOptions
    from tofcorr.comparison.select import select
    from tofcorr.options import resolve_options

    options = resolve_options(SelectionOptions, config, changes)
    click.echo(repr(select(recordings, options, out=out, force=force)))
    click.echo(f"Written to {out}.")
