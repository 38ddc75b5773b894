"""The option `--verbose` of every command."""

import click


def with_verbose(command: click.Command) -> click.Command:
    """Add `--verbose` to a command, unless it has it already, and return the command."""
    if not any(option.name == "verbose" for option in command.params):
        command.params.append(
            click.Option(
                ["--verbose"],
                is_flag=True,
                expose_value=False,
                callback=_set_up,
                help="Log every step to standard error, in place of progress bars.",
            )
        )
    return command


def _set_up(context: click.Context, option: click.Parameter, asked: bool) -> None:
    if asked:
        from tofcorr.progress import log_to_stderr

        log_to_stderr()
