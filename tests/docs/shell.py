"""The shell commands of the documents: found, parsed by the real command line, and run."""

import re
import shlex
from pathlib import Path

import click
from docs.pages import blocks
from optional import present

from tofcorr.cli.main import group

_SHELLS = ("bash", "sh", "console", "powershell")


def tofcorr_commands(page: Path) -> list[str]:
    """Return the `tofcorr` commands of a page's shell blocks, continued lines joined."""
    found = []
    for block in blocks(page):
        if block.language in _SHELLS:
            text = re.sub(r"[\\`]\n\s*", " ", block.text)
            lines = [line.strip().removeprefix("$ ") for line in text.splitlines()]
            found += [re.sub(r"^python3? -m tofcorr\b", "tofcorr", line) for line in lines]
    # What the shell does with the output is not the program's business.
    found = [re.split(r" [>|] ", line)[0] for line in found]
    return [line for line in found if line.startswith("tofcorr ")]


def parsed(line: str) -> click.Context | None:
    """Parse a command line as a user's shell would; nothing is run. None: it only asks for help.

    Raises:
        click.ClickException: There is no such command or option, or a value is refused.
    """
    command: click.Command = group
    name, rest = "tofcorr", shlex.split(line, comments=True)[1:]
    while isinstance(command, click.Group) and rest and not rest[0].startswith("-"):
        found, under, rest = command.resolve_command(click.Context(command), rest)
        name, command = str(found), present(under)
    try:
        return command.make_context(name, list(rest))
    except click.exceptions.Exit:
        return None


def run_command(line: str) -> None:
    """Run a command line in this process.

    Raises:
        TofcorrError: The command refuses its input.
    """
    group.main(shlex.split(line, comments=True)[1:], prog_name="tofcorr", standalone_mode=False)
