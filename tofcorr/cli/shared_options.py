"""Options that several commands take: `--config` and `--set`, `--recording`, `--force`."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import click
from click.shell_completion import CompletionItem

Command = TypeVar("Command", bound=Callable[..., Any])


class ConfigName(click.ParamType):
    """The name of a shipped configuration, or a file; completed by the shell as either."""

    name = "name|file"

    def __init__(self, folder: str) -> None:
        self.folder = folder

    def shell_complete(
        self, ctx: click.Context, param: click.Parameter, incomplete: str
    ) -> list[CompletionItem]:
        """Return the shipped names that begin so; otherwise let the shell list files."""
        from tofcorr.options import shipped_names

        names = [name for name in shipped_names(self.folder) if name.startswith(incomplete)]
        return [CompletionItem(name) for name in names] or [CompletionItem(incomplete, type="file")]


force_option = click.option(
    "--force",
    is_flag=True,
    help="Go on although `tofcorr inspect` finds that the recording cannot be what it says.",
)
"""The option of every command that looks at a recording first; the command receives a bool."""


def recordings_option(help_text: str) -> Callable[[Command], Command]:
    """Add `--recording`, once or several times; the command receives `recordings`, paths."""
    return click.option(
        "--recording",
        "recordings",
        required=True,
        multiple=True,
        type=click.Path(path_type=Path),
        help=help_text,
    )


def config_options(
    folder: str, what: str, example: str, default: str | None = None
) -> Callable[[Command], Command]:
    """Add `--config` and `--set`; the command receives `config: str` and `changes: tuple[str]`.

    Args:
        folder: Folder below `configs/` with the shipped configurations of the command.
        what: What the configuration describes, for the help text.
        example: Of a changed option, for the help text.
        default: Name of the configuration used without `--config`; None: it must be given.
    """
    # For click a default of None is a value given, so --config would no longer be required.
    need: dict[str, Any] = (
        {"required": True} if default is None else {"default": default, "show_default": True}
    )
    config = click.option(
        "--config",
        type=ConfigName(folder),
        help=f"{what}: a shipped name (see: tofcorr configs) or a YAML file.",
        **need,
    )
    changes = click.option(
        "--set",
        "changes",
        multiple=True,
        metavar="KEY=VALUE",
        help=f"Change one option, such as --set {example}; may be repeated.",
    )
    return lambda command: config(changes(command))
