"""`python -m benchmarks.withheld pairs`: generate, diagnose, score, or all of it."""

from pathlib import Path

import click
from tqdm import tqdm

from benchmarks.withheld import steps
from benchmarks.withheld.counts import counts_by_name

KINDS = (
    *("ideal", "no_effect", "hand_eye", "terms", "shared"),
    *("nothing", "other", "other_nothing", "noise", "renderer"),
)

_cases = steps.cases_of("kind", 40)
_kinds = click.option(
    "--kinds",
    default=",".join(KINDS),
    show_default=True,
    help="Kinds; nothing:100 asks for 100 of them.",
)
_workers = steps.processes("--workers")


def counts_of(kinds: str, cases: int) -> dict[str, int]:
    """Pairs of each kind from text such as `ideal,nothing:100`."""
    return counts_by_name(kinds, cases, KINDS, "kind of pair")


@click.group(context_settings={"help_option_names": ["-h", "--help"]})
def pairs() -> None:
    """Check `tofcorr diagnose --sim RECORDING` on pairs of a camera and a simulator."""


@pairs.command("generate")
@steps.SEED
@_cases
@_kinds
@steps.OUT
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
@steps.OUT
@_workers
@steps.LIMIT
@steps.CONFIG
def diagnose_command(out: Path, workers: int, limit_s: float, config: Path | None) -> None:
    """Run `tofcorr diagnose` on the recordings alone; go on where it was interrupted."""
    from benchmarks.withheld.diagnose import Plan, waiting

    plan = Plan(workers, limit_s, config.read_text() if config else "")
    steps.run_diagnoses(out, waiting(out), plan)


@pairs.command("score")
@steps.OUT
@_workers
def score_command(out: Path, workers: int) -> None:
    """Open the answers, check their seals, print the table, write pairs.json."""
    from benchmarks.withheld.pairs.degraded import read_degraded
    from benchmarks.withheld.pairs.outcomes import PairOutcome
    from benchmarks.withheld.pairs.scoring import score_pairs
    from benchmarks.withheld.pairs.table import line, write_scores

    outcomes = [
        PairOutcome(one, read_degraded(out, one.name, one.answer))
        for one in steps.answered(out, workers)
    ]
    outcomes.sort(key=lambda one: (KINDS.index(one.kind), one.outcome.index))
    scores = score_pairs(outcomes)
    write_scores(scores, outcomes, out / "pairs.json")
    for one in scores:
        click.echo(line(one))
    click.echo(f"{out / 'pairs.json'}")


@pairs.command("all")
@steps.SEED
@_cases
@_kinds
@steps.OUT
@_workers
@steps.LIMIT
@steps.CONFIG
@click.pass_context
def all_command(context: click.Context, /, **options: object) -> None:
    """Generate, diagnose and score."""
    steps.in_turn(context, (generate_command, diagnose_command, score_command), options)
