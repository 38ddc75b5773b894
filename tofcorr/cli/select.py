"""`tofcorr select`: which model predicts best what it has not seen."""

from pathlib import Path

import click

from tofcorr.cli.config_option import config_options


@click.command(name="select", short_help="Choose a model by held-out error.")
@config_options("select", "The models and what is held out", default="paper")
@click.option(
    "--recording",
    "recordings",
    required=True,
    multiple=True,
    type=click.Path(path_type=Path),
    help="Folder of a recording; several of one camera are taken together.",
)
@click.option("--out", required=True, type=click.Path(path_type=Path), help="New folder.")
def command(config: str, changes: tuple[str, ...], recordings: tuple[Path, ...], out: Path) -> None:
    """Compare models on images, distances and targets that they were not fitted to.

    Names the simplest model within one standard error of the best, and those that the data do
    not tell from it. Writes selection.json and selection.md to OUT.
    """
    import json

    from tqdm import tqdm

    from tofcorr.comparison.selection import group_frames, select
    from tofcorr.comparison.selection_options import SelectionOptions
    from tofcorr.comparison.selection_report import selection_mapping, selection_markdown
    from tofcorr.data.recording import Recording
    from tofcorr.data.staging import StagedFolder
    from tofcorr.options import resolve_options
    from tofcorr.pixels.dataset import Dataset

    options = resolve_options(SelectionOptions, config, changes)
    dataset = Dataset(tuple(Recording.open(path) for path in recordings))
    with StagedFolder(out) as stage:
        groups, _ = group_frames(dataset, options)
        total = len(options.models) * sum(len(parts) for parts in groups.values())
        with tqdm(total=total, unit="fit", desc="Comparing", disable=None) as bar:
            selection = select(dataset, options, bar.update)
        text = selection_markdown(selection, options)
        mapping = selection_mapping(selection, options)
        (stage.folder / "selection.md").write_text(text, encoding="utf-8")
        (stage.folder / "selection.json").write_text(
            json.dumps(mapping, indent=1, allow_nan=False) + "\n", encoding="utf-8"
        )
    click.echo(text)
    click.echo(f"Written to {out}.")
