"""`python -m benchmarks.withheld pairs`: generate, diagnose, score, or all of it."""

from pathlib import Path

import click
from tqdm import tqdm

from benchmarks.withheld.counts import counts_by_name

KINDS = (
    *("ideal", "no_effect", "hand_eye", "terms", "shared"),
    *("nothing", "other", "other_nothing", "noise", "renderer"),
)

_out = click.option(
    "--out", type=click.Path(path_type=Path), required=True, help="Folder of the whole check."
)
_seed = click.option("--seed", type=click.IntRange(0), required=True, help="Draws the pairs.")
_cases = click.option(
    "--cases", type=click.IntRange(1), default=40, show_default=True, help="Pairs of a kind."
)
_kinds = click.option(
    "--kinds",
    default=",".join(KINDS),
    show_default=True,
    help="Kinds; nothing:100 asks for 100 of them.",
)
_workers = click.option("--workers", type=click.IntRange(1), default=2, show_default=True)
_limit = click.option(
    "--limit", "limit_s", default=300.0, show_default=True, help="Seconds for one pair."
)
_config = click.option(
    "--config",
    type=click.Path(exists=True, path_type=Path),
    help="Configuration handed to `tofcorr diagnose`.",
)


def counts_of(kinds: str, cases: int) -> dict[str, int]:
    """Pairs of each kind from text such as `ideal,nothing:100`."""
    return counts_by_name(kinds, cases, KINDS, "kind of pair")


@click.group(context_settings={"help_option_names": ["-h", "--help"]})
def pairs() -> None:
    """Check `tofcorr diagnose --sim RECORDING` on pairs of a camera and a simulator."""


@pairs.command("generate")
@_seed
@_cases
@_kinds
@_out
def generate_command(seed: int, cases: int, kinds: str, out: Path) -> None:
    """Write the recordings of both and, apart, sealed answers."""
    from benchmarks.withheld.pairs.cases import generate
    from benchmarks.withheld.pairs.renderer import missing

    counts = counts_of(kinds, cases)
    if "renderer" in counts and (reason := missing()):
        click.echo(f"Pairs of the kind `renderer` are left out. {reason}", err=True)
        del counts["renderer"]
    for _ in tqdm(generate(seed, counts, out), "pairs", sum(counts.values()), unit=""):
        pass


@pairs.command("diagnose")
@_out
@_workers
@_limit
@_config
def diagnose_command(out: Path, workers: int, limit_s: float, config: Path | None) -> None:
    """Run `tofcorr diagnose` on the recordings alone; go on where it was interrupted."""
    from benchmarks.withheld.diagnose import Plan, diagnose, waiting

    plan = Plan(workers, limit_s, config.read_text() if config else "")
    entries, failed = waiting(out), 0
    with tqdm(diagnose(out, entries, plan), "diagnoses", len(entries), unit="") as runs:
        for _, code in runs:
            failed += code != 0
            runs.set_postfix(failed=failed)


@pairs.command("score")
@_out
@_workers
def score_command(out: Path, workers: int) -> None:
    """Open the answers, check their seals, print the table, write pairs.json."""
    from concurrent.futures import ProcessPoolExecutor

    from benchmarks.withheld.outcomes import open_answers
    from benchmarks.withheld.pairs.outcomes import PairOutcome, read_degraded
    from benchmarks.withheld.pairs.scoring import score_pairs
    from benchmarks.withheld.pairs.table import line, write_scores

    with ProcessPoolExecutor(workers) as pool:
        opened = list(tqdm(open_answers(out, pool.map), desc="answers", unit=""))
    run = [one for one in opened if one.said.failure != "not run"]
    if len(run) < len(opened):
        click.echo(f"{len(opened) - len(run)} of {len(opened)} pairs are not diagnosed; left out.")
    outcomes = [PairOutcome(one, read_degraded(out, one.name, one.answer)) for one in run]
    outcomes.sort(key=lambda one: (KINDS.index(one.kind), one.outcome.index))
    scores = score_pairs(outcomes)
    write_scores(scores, outcomes, out / "pairs.json")
    for one in scores:
        click.echo(line(one))
    click.echo(f"{out / 'pairs.json'}")


@pairs.command("all")
@_seed
@_cases
@_kinds
@_out
@_workers
@_limit
@_config
@click.pass_context
def all_command(context: click.Context, /, **options: object) -> None:
    """Generate, diagnose and score."""
    for command in (generate_command, diagnose_command, score_command):
        wanted = {parameter.name for parameter in command.params}
        context.invoke(command, **{key: value for key, value in options.items() if key in wanted})
