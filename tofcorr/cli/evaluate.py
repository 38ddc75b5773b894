"""`tofcorr evaluate`: models side by side on held-out images."""

from pathlib import Path

import click

from tofcorr.cli.shared_options import config_options, force_option, recordings_option
from tofcorr.files.arguments import NewPath


@click.command()
@config_options("evaluate", "The models and how they are compared", "seed=1", default="paper")
@recordings_option("A set of images: one row of the tables; may be given several times.")
@click.option(
    "--out",
    required=True,
    type=NewPath(),
    help="Folder of the report; must be new.",
)
@click.option("--device", default=None, help="Where to compute; overrides the configuration.")
@force_option
def command(
    config: str,
    changes: tuple[str, ...],
    recordings: tuple[Path, ...],
    out: Path,
    device: str | None,
    force: bool,
) -> None:
    """Compare models on held-out images, in the paper's two tables.

    Every RECORDING is evaluated on its own, as one set: a random half held out, k-fold
    cross-validation by image with paired t-tests, and repeated random splits if asked for. The
    columns "before" (no calibration) and "hand-eye only" (no depth correction) are there to compare
    with. Writes evaluation.json, evaluation.md, comparison.png and TensorBoard files to OUT.
    """
    from tofcorr.comparison.evaluate import evaluate
    from tofcorr.comparison.options import EvaluationOptions
    from tofcorr.options import resolve_options

    options = resolve_options(EvaluationOptions, config, changes)
    if device:
        options = options.model_copy(update={"device": device})
    click.echo(repr(evaluate(recordings, options, out=out, force=force)))
    click.echo(f"\nWritten to {out}.")
