"""The shell commands of the documents: found, parsed by the real command line, and run."""

import re
from collections.abc import Sequence
from pathlib import Path

import click
from docs.pages import blocks

from tofcorr.cli.main import group


def tofcorr_commands(page: Path) -> list[str]:
    """Return the `tofcorr` commands of a page's shell blocks, continued lines joined."""
    found = []
    for block in blocks(page):
        if block.language in ("bash", "sh", "console", "powershell"):
            text = re.sub(r"[\\`]\n\s*", " ", block.text)
            lines = [line.strip().removeprefix("$ ") for line in text.splitlines()]
            found += [re.sub(r"^python -m tofcorr\b", "tofcorr", line) for line in lines]
    return [line for line in found if line.startswith("tofcorr ")]


def parse(words: Sequence[str]) -> click.Context:
    """Parse `tofcorr` and what follows, as a user would; nothing is run.

    Raises:
        click.ClickException: There is no such command or option, or a value is refused.
    """
    command: click.Command = group
    context = None
    rest = list(words)[1:]
    while True:
        # Files and folders that a page only talks about need not exist.
        context = command.make_context(command.name, _lenient(command, rest), parent=context)
        if not isinstance(command, click.Group):
            return context
        name, found, rest = command.resolve_command(
            context, [*context.protected_args, *context.args]
        )
        assert found is not None, name
        command = found
