"""`tofcorr evaluate`: models side by side on held-out images."""

import click

from tofcorr.cli.config_option import config_options


@click.command()
@config_options("evaluate", "The models and how they are compared", default="paper")
@click.option(
    "--recording",
    "recordings",
    required=True,
    multiple=True,
    type=click.Path(),
    help="A set of images: one row of the tables; may be given several times.",
)
@click.option("--out", required=True, type=click.Path(), help="Folder of the report; must be new.")
@click.option("--device", default=None, help="Where to compute; overrides the configuration.")
def command(
    config: str, changes: tuple[str, ...], recordings: tuple[str, ...], out: str, device: str | None
) -> None:
    """Compare models on held-out images, in the paper's two tables.

    Every RECORDING is evaluated on its own, as one set: a random half held out, k-fold
    cross-validation by image with paired t-tests, and repeated random splits if asked for. The
    columns "before" and "hand-eye only" stand beside the models. Writes evaluation.json,
    evaluation.md, comparison.png and TensorBoard files to OUT.
    """
    from tqdm import tqdm

    from tofcorr.comparison.evaluation import evaluate, num_fits, set_names
    from tofcorr.comparison.evaluation_options import EvaluationOptions
    from tofcorr.comparison.evaluation_report import write_evaluation
    from tofcorr.data.recording import Recording
    from tofcorr.data.staging import StagedFolder
    from tofcorr.options import resolve_options
    from tofcorr.pixels.dataset import Dataset

    options = resolve_options(EvaluationOptions, config, changes)
    if device:
        options = options.model_copy(update={"device": device})
    with StagedFolder(out) as stage:
        sets = [Dataset((Recording.open(path),)) for path in recordings]
        evaluations = []
        total = num_fits(options) * len(sets)
        with tqdm(total=total, unit="fit", desc="Evaluating", disable=None) as bar:
            for name, dataset in zip(set_names(recordings), sets, strict=True):
                evaluations.append(evaluate(name, dataset, options, bar.update))
        text = write_evaluation(stage.folder, evaluations, options)
    click.echo(text)
    click.echo(f"\nWritten to {out}.")
