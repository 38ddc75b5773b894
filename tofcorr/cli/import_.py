"""`tofcorr import`: recorded images become a recording, one sub-command per importer."""

from importlib import import_module

import click

from tofcorr.cli.verbose import with_verbose
from tofcorr.importing.registry import IMPORTERS


class _Importers(click.Group):
    """A group with one sub-command per importer, loaded when it is called."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(IMPORTERS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in IMPORTERS:
            return None
        module = import_module(f"tofcorr.importing.{IMPORTERS[cmd_name].module}")
        return with_verbose(module.command)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        with formatter.section("Commands"):
            formatter.write_dl([(entry.name, entry.summary) for entry in IMPORTERS.values()])


@click.group(cls=_Importers, context_settings={"help_option_names": ["-h", "--help"]})
def command() -> None:
    """Turn recorded images into a recording."""
