"""What commands share: their group, and the options that several of them take."""

from collections.abc import Callable, Mapping
from functools import wraps
from importlib import import_module
from pathlib import Path
from typing import Any, Protocol, TypeVar

import click
from click.shell_completion import CompletionItem

from tofcorr.errors import did_you_mean
from tofcorr.files import NewPath
from tofcorr.importing.command_line import option

Command = TypeVar("Command", bound=Callable[..., Any])
FOLDER = click.Path(path_type=Path)


class LazyGroup(click.Group):
    """A group whose `--help` imports none of its commands (click's documentation: lazy loading).

    Args:
        lazy: Where each command is below `tofcorr`, `module:name`, and its line in the help of the
            group, in the order in which they are listed.
        more: As for `click.Group`.
    """

    def __init__(self, *, lazy: Mapping[str, tuple[str, str]], **more: Any) -> None:  # noqa: ANN401
        super().__init__(**more)
        self._lazy = lazy

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the names."""
        return list(self._lazy)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Import a command, and add `--verbose` to it; None: there is none of this name."""
        if cmd_name not in self._lazy:
            return None
        place, summary = self._lazy[cmd_name]
        module, _, name = place.partition(":")
        command: click.Command = getattr(import_module(f"tofcorr.{module}"), name)
        command.short_help = summary
        known = any(option.name == "verbose" for option in command.params)
        # The commands of a group below have the option; the group itself has none.
        return command if known or isinstance(command, click.Group) else _VERBOSE(command)

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Return the command that was named; refuse an unknown one with the nearest."""
        if args[0] not in self._lazy and not ctx.resilient_parsing:
            ctx.fail(f"No such command '{args[0]}'.{did_you_mean(args[0], self._lazy)}")
        return super().resolve_command(ctx, args)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """List names and summaries."""
        with formatter.section("Commands"):
            formatter.write_dl([(name, summary) for name, (_, summary) in self._lazy.items()])


class Result(Protocol):
    """What a command found: its `repr` is a few lines, its `details` all that it has to say."""

    @property
    def details(self) -> str:
        """Verdict, every table and every warning."""
        ...


_ASKED_FOR_ALL = "tofcorr.verbose"


def show(result: Result, *written: Path | None) -> None:
    """Print the few lines of a result, or all with `--verbose`; then what was written.

    Args:
        result: What the command found.
        written: Files and folders that it wrote; None: not asked for.
    """
    all_of_it = click.get_current_context().meta.get(_ASKED_FOR_ALL, False)
    click.echo(result.details if all_of_it else repr(result))
    for out in filter(None, written):
        files = {one.name for one in out.iterdir()} if out.is_dir() else set[str]()
        # What is for people stands first.
        names = ", ".join(sorted(files, key=lambda name: (not name.endswith(".html"), name)))
        click.echo(f"Written to {out}{names and f': {names}'}")


def _log_every_step(context: click.Context, option: click.Parameter, asked: bool) -> None:
    context.meta[_ASKED_FOR_ALL] = asked
    if asked:
        from tofcorr.progress import log_to_stderr

        log_to_stderr()


_LOGGED = "Print all results, and log every step to standard error in place of progress bars."
_VERBOSE = option("--verbose", _LOGGED, is_flag=True, expose_value=False, callback=_log_every_step)


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


_FORCED = "Go on although `tofcorr inspect` finds that the recording cannot be what it says."
force_option = option("--force", _FORCED, is_flag=True)
"""The option of every command that looks at a recording first; the command receives a bool."""


run_option = option("--run", "Folder that tofcorr train made.", required=True, type=FOLDER)
"""The option of every command that uses a calibration; the command receives a path."""


def out_option(
    text: str, kind: click.ParamType | None = None, *, required: bool = True
) -> Callable[[Command], Command]:
    """Add `--out`, a name that is new unless another kind is given; the command receives a path."""
    return option("--out", text, required=required, type=kind or NewPath())


def recording_option(text: str, *, many: bool = False) -> Callable[[Command], Command]:
    """Add `--recording`; the command receives `recording_path`, or, of many, `recordings`."""
    named = "recordings" if many else "recording_path"
    return option("--recording", text, named, required=True, multiple=many, type=FOLDER)


def config_options(
    options: str, folder: str, what: str, example: str, default: str | None = None
) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Add `--config` and `--set`; the command receives the options that they make, first.

    Args:
        options: Where their class is below `tofcorr`, `module:class`; imported when it is needed.
        folder: Folder below `configs/` with the shipped configurations of the command.
        what: What the configuration describes, for the help text.
        example: Of a changed option, for the help text.
        default: Name of the configuration used without `--config`; None: it must be given.
    """
    # For click a default of None is a value given, so --config would no longer be required.
    need = {"required": True} if default is None else {"default": default}
    known = f"{what}: a shipped name (see: tofcorr configs) or a YAML file."
    changed = f"Change one option, such as --set {example}; may be repeated."
    module, _, name = options.partition(":")

    def decorated(command: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(command)
        def resolved(config: str, changes: tuple[str, ...], **given: Any) -> Any:  # noqa: ANN401
            from tofcorr.options import resolve_options

            kind = getattr(import_module(f"tofcorr.{module}"), name)
            return command(resolve_options(kind, config, changes), **given)

        named = option("--config", known, type=ConfigName(folder), **need)
        change = option("--set", changed, "changes", multiple=True, metavar="KEY=VALUE")
        return named(change(resolved))

    return decorated
