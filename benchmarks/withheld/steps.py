"""Options and steps that the command lines of the checks share."""

from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from tqdm import tqdm

if TYPE_CHECKING:
    from benchmarks.withheld.diagnose import Plan
    from benchmarks.withheld.outcomes import Outcome

Option = Callable[[Callable[..., Any]], Callable[..., Any]]

OUT: Option = click.option(
    "--out", type=click.Path(path_type=Path), required=True, help="Folder of the whole check."
)
SEED: Option = click.option(
    "--seed", type=click.IntRange(0), required=True, help="Draws the cases."
)
LIMIT: Option = click.option(
    "--limit", "limit_s", default=300.0, show_default=True, help="Seconds for one recording."
)
CONFIG: Option = click.option(
    "--config",
    type=click.Path(exists=True, path_type=Path),
    help="Configuration handed to `tofcorr diagnose`.",
)


def processes(name: str) -> Option:
    """Return the option `name` that says how many processes share the work."""
    return click.option(name, type=click.IntRange(1), default=2, show_default=True)


def cases_of(kind: str, default: int) -> Option:
    """Return the option for the number of cases of each `kind` that names no number itself."""
    return click.option(
        "--cases",
        type=click.IntRange(1),
        default=default,
        show_default=True,
        help=f"Cases of a {kind}.",
    )


def run_diagnoses(out: Path, entries: list[dict], plan: "Plan", what: str = "diagnoses") -> None:
    """Diagnose each of `entries`, with a bar that counts those that failed."""
    from benchmarks.withheld.diagnose import diagnose

    failed = 0
    with tqdm(diagnose(out, entries, plan), what, len(entries), unit="") as runs:
        for _, code in runs:
            failed += code != 0
            runs.set_postfix(failed=failed)


def answered(out: Path, workers: int) -> list["Outcome"]:
    """Open the answers, check their seals, and return those of recordings that were diagnosed."""
    from benchmarks.withheld.outcomes import open_answers

    with ProcessPoolExecutor(workers) as pool:
        outcomes = list(tqdm(open_answers(out, pool.map), desc="answers", unit=""))
    run = [one for one in outcomes if one.said.failure != "not run"]
    if left := len(outcomes) - len(run):
        click.echo(f"{left} of {len(outcomes)} recordings are not diagnosed; left out.", err=True)
    return run


def in_turn(
    context: click.Context, commands: Sequence[click.Command], options: dict[str, object]
) -> None:
    """Invoke each command with those of the options that it takes."""
    for command in commands:
        wanted = {parameter.name for parameter in command.params}
        context.invoke(command, **{key: value for key, value in options.items() if key in wanted})
