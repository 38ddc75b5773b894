"""`python -m benchmarks.withheld`: generate, diagnose, baselines, score, or all of it; pairs."""

import os
from pathlib import Path

import click
from tqdm import tqdm

from benchmarks.withheld import steps
from benchmarks.withheld.counts import counts_by_name
from benchmarks.withheld.pairs.commands import pairs

# Processes share the work; threads inside each would only wait for one another.
os.environ.setdefault("OMP_NUM_THREADS", "1")

TIERS = "A,B,C,D,E,F,G,H,I,J"
REAL = "K"  # needs $TOFCORR_REAL_DATA; its number of cases is fixed

_cases = steps.cases_of("tier", 40)
_tiers = click.option(
    "--tiers", default=TIERS, show_default=True, help="Tiers; C:400 asks for 400 cases of C."
)
_workers = steps.processes("--workers")
_key = click.option(
    "--exclude-key",
    default="leave_out",
    show_default=True,
    help="Key of that configuration that lists effects to do without (tier E).",
)
_only = click.option(
    "--baseline-tiers", "only", default="A,B,C", show_default=True, help="Tiers for the baselines."
)
_most = click.option(
    "--baseline-most", "most", default=100, show_default=True, help="At most so many of a tier."
)
_title = click.option("--title", default="tofcorr diagnose on withheld effects", show_default=True)


def counts_of(tiers: str, cases: int) -> dict[str, int]:
    """Cases of each tier from text such as `A,B,C:400`."""
    return counts_by_name(tiers, cases, [*TIERS.split(","), REAL], "tier")


@click.group(context_settings={"help_option_names": ["-h", "--help"]})
def group() -> None:
    """Check `tofcorr diagnose` on recordings whose effect is withheld from it."""


@group.command("generate")
@steps.SEED
@_cases
@_tiers
@steps.OUT
def generate_command(seed: int, cases: int, tiers: str, out: Path) -> None:
    """Write recordings and, apart, sealed answers."""
    from benchmarks.withheld.cases import generate
    from benchmarks.withheld.real import generate_real

    counts = counts_of(tiers, cases)
    real = counts.pop(REAL, 0)
    if real and "TOFCORR_REAL_DATA" not in os.environ:
        raise click.UsageError("tier K needs the folder of real recordings in $TOFCORR_REAL_DATA")
    for _ in tqdm(generate(seed, counts, out), desc="recordings", unit=""):
        pass
    for _ in tqdm(generate_real(seed, out) if real else (), desc="real images", unit=""):
        pass


@group.command("diagnose")
@steps.OUT
@_workers
@steps.LIMIT
@steps.CONFIG
@_key
def diagnose_command(
    out: Path, workers: int, limit_s: float, config: Path | None, exclude_key: str
) -> None:
    """Run `tofcorr diagnose` on the recordings alone; go on where it was interrupted."""
    from benchmarks.withheld.diagnose import Plan, waiting

    plan = Plan(workers, limit_s, config.read_text() if config else "", exclude_key)
    steps.run_diagnoses(out, waiting(out), plan)


@group.command("baselines")
@steps.OUT
@_workers
@_only
@_most
def baselines_command(out: Path, workers: int, only: str, most: int) -> None:
    """Run the baselines on the same recordings."""
    from benchmarks.withheld.baselines.run import choose, run_baselines

    waiting = choose(out, tuple(only.split(",")), most)
    for _ in tqdm(run_baselines(out, waiting, workers), "baselines", len(waiting), unit=""):
        pass


@group.command("score")
@steps.OUT
@_workers
@_title
def score_command(out: Path, workers: int, title: str) -> None:
    """Open the answers, check their seals, score, and write the page."""
    from benchmarks.withheld.page import write_page

    scores = write_page(steps.answered(out, workers), out, title)
    for one in scores:
        met = {None: "", True: "met", False: "missed"}[one.met]
        low, high = one.interval
        click.echo(
            f"{one.tier:4s}{one.value:7.2f} [{low:.2f}, {high:.2f}] n={one.count:<4d} "
            f"{one.what} {one.target} {met}"
        )
    click.echo(f"{out / 'page.html'}")


@group.command("all")
@steps.SEED
@_cases
@_tiers
@steps.OUT
@_workers
@steps.LIMIT
@steps.CONFIG
@_key
@_title
@click.pass_context
def all_command(context: click.Context, /, **options: object) -> None:
    """Generate, diagnose, run the baselines and score."""
    commands = (generate_command, diagnose_command, baselines_command, score_command)
    steps.in_turn(context, commands, options)


group.add_command(pairs)


if __name__ == "__main__":
    group()
