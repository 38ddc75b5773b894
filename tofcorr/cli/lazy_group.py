"""A group of commands whose modules are imported only when they are called."""

from collections.abc import Mapping
from importlib import import_module
from typing import Any, NamedTuple

import click

from tofcorr.cli.verbose import with_verbose


class Entry(NamedTuple):
    """One command of a group.

    Attributes:
        module: Where it is: a module that holds a `click.Command` called `command`.
        summary: Its line in the help of the group, and beside its name where a shell completes it.
    """

    module: str
    summary: str


class LazyGroup(click.Group):
    """A group whose `--help` imports none of its commands.

    Args:
        entries: The commands by name, in the order in which they are listed.
        more: As for `click.Group`.
    """

    def __init__(self, *, entries: Mapping[str, Entry], **more: Any) -> None:  # noqa: ANN401
        super().__init__(**more)
        self._entries = entries

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the names."""
        return list(self._entries)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Import a command; None: there is none of this name."""
        entry = self._entries.get(cmd_name)
        if entry is None:
            return None
        command: click.Command = import_module(entry.module).command
        command.short_help = entry.summary
        # The commands of a group below have the option; the group itself has none.
        return command if isinstance(command, click.Group) else with_verbose(command)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """List names and summaries."""
        with formatter.section("Commands"):
            formatter.write_dl([(name, entry.summary) for name, entry in self._entries.items()])
