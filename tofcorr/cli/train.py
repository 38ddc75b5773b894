"""`tofcorr train`: calibrate recordings and write the run folder."""

from pathlib import Path

import click

from tofcorr.cli.shared_options import config_options, force_option, recordings_option
from tofcorr.files.arguments import NewPath


@click.command()
@config_options("train", "The model and the training", "solver.max_iterations=30", default="ea")
@recordings_option("Folder of a recording; may be given several times for one camera.")
@click.option("--out", required=True, type=NewPath(), help="Folder of the run, made anew.")
@click.option(
    "--resume",
    type=click.Path(path_type=Path),
    help="Folder of an interrupted run; the fit goes on where it stood.",
)
@force_option
@click.option("--no-figures", is_flag=True, help="Draw no figures for TensorBoard.")
def command(
    config: str,
    changes: tuple[str, ...],
    recordings: tuple[Path, ...],
    out: Path,
    resume: Path | None,
    *,
    no_figures: bool,
    force: bool,
) -> None:
    """Fit the error model and the hand-eye transform to recorded frames.

    Half of the poses are held out (see the configuration); the errors on them are those to expect
    on new frames. Ctrl-C ends the fit early and files it as interrupted; --resume goes on from
    there.
    """
    from tofcorr.options import resolve_options
    from tofcorr.training.options import TrainingOptions
    from tofcorr.training.run import train

    options = resolve_options(TrainingOptions, config, changes)
    if no_figures:
        options = options.model_copy(update={"figures": False})
    result = train(recordings, options, out=out, resume=resume, force=force)
    click.echo(repr(result))
    click.echo(f"{result.report['message']} Run filed in {out}")
