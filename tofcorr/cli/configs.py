"""`tofcorr configs`, and `tofcorr import` with one sub-command per importer."""

from pathlib import Path

import click

from tofcorr.cli.shared import LazyGroup
from tofcorr.importing.registry import IMPORTERS


@click.group(
    cls=LazyGroup,
    lazy={
        name: (f"importing.{importer.module}:command", importer.summary)
        for name, importer in IMPORTERS.items()
    },
    context_settings={"help_option_names": ["-h", "--help"]},
)
def import_command() -> None:
    """Turn recorded images into a recording."""


@click.command()
@click.argument("name", required=False)
def configs_command(name: str | None) -> None:
    """List the shipped configurations, or print the one called NAME.

    The folders are the commands that read them; a folder's name lists it alone. Where two folders
    have one of the same name, write FOLDER/NAME, such as train/ea. To edit one, save it to a file:
    tofcorr configs ea > mine.yaml
    """
    from tofcorr.options import shipped_folders

    folders = shipped_folders()
    if name is not None and name not in folders:
        click.echo(_file(name).read_text(encoding="utf-8"), nl=False)
        return
    wanted = folders if name is None else [name]
    click.echo("\n\n".join(_listing(folder) for folder in wanted))


def _listing(folder: str) -> str:
    """Return the names of one folder of `configs/`, each with its first comment line."""
    from tofcorr.options import configs_folder, shipped_names

    names = shipped_names(folder)
    width = max(map(len, names), default=0)
    lines = [
        f"  {name:<{width}}  {_summary(configs_folder() / folder / f'{name}.yaml')}"
        for name in names
    ]
    return "\n".join([f"{folder}:", *lines])


def _file(name: str) -> Path:
    """Return the shipped file of a name, with or without its folder."""
    from difflib import get_close_matches

    from tofcorr.errors import ConfigError
    from tofcorr.options import configs_folder, shipped_folders, shipped_names

    every = [f"{folder}/{one}" for folder in shipped_folders() for one in shipped_names(folder)]
    matches = [one for one in every if name in (one, one.partition("/")[2])]
    if len(matches) > 1:
        raise ConfigError(f"'{name}' stands for {' and '.join(matches)}; name one of them.")
    if not matches:
        known = [*every, *(one.partition("/")[2] for one in every)]
        close = get_close_matches(name, known, n=1)
        hint = f" Did you mean '{close[0]}'?" if close else ""
        raise ConfigError(f"no configuration '{name}' is shipped.{hint} List: tofcorr configs")
    return configs_folder() / f"{matches[0]}.yaml"


def _summary(path: Path) -> str:
    """Return the first comment line of a configuration."""
    with path.open(encoding="utf-8") as file:
        return file.readline().removeprefix("#").strip()
