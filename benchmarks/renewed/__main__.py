"""`python -m benchmarks.renewed`: generate, diagnose, remains, score, or all of it."""

import os
from pathlib import Path

import click
from tqdm import tqdm

from benchmarks.withheld import steps
from benchmarks.withheld.counts import counts_by_name

# Processes share the work; threads inside each would only wait for one another.
os.environ.setdefault("OMP_NUM_THREADS", "1")

TIERS = "E,N,O"
REAL = "K"  # needs $TOFCORR_REAL_DATA; its number of cases is fixed
CONFIG = "simulate_anew: false\npage: false\n"

_cases = steps.cases_of("tier", 59)
_tiers = click.option(
    "--tiers", default=TIERS, show_default=True, help="Tiers; N:400 asks for 400 cases of N."
)
_jobs = steps.processes("--jobs")


@click.group(context_settings={"help_option_names": ["-h", "--help"]})
def group() -> None:
    """Check `tofcorr diagnose` on recordings that nobody tuned it on."""


@group.command("generate")
@steps.SEED
@_cases
@_tiers
@steps.OUT
def generate_command(seed: int, cases: int, tiers: str, out: Path) -> None:
    """Write recordings and, apart, sealed answers."""
    from benchmarks.renewed.cases import generate
    from benchmarks.renewed.real import generate_real

    counts = counts_by_name(tiers, cases, [*TIERS.split(","), REAL], "tier")
    real = counts.pop(REAL, 0)
    if real and "TOFCORR_REAL_DATA" not in os.environ:
        raise click.UsageError("tier K needs the folder of real recordings in $TOFCORR_REAL_DATA")
    total = sum(counts.values())
    for _ in tqdm(generate(seed, counts, out), "recordings", total, unit=""):
        pass
    for _ in tqdm(generate_real(seed, out) if real else (), desc="real images", unit=""):
        pass


@group.command("diagnose")
@steps.OUT
@_jobs
@steps.LIMIT
def diagnose_command(out: Path, jobs: int, limit_s: float) -> None:
    """Run `tofcorr diagnose` on the recordings alone; go on where it was interrupted."""
    from benchmarks.withheld.diagnose import Plan, waiting

    steps.run_diagnoses(out, waiting(out), Plan(jobs, limit_s, CONFIG), "diagnoses")


@group.command("remains")
@steps.OUT
@_jobs
def remains_command(out: Path, jobs: int) -> None:
    """Measure the true gaps of every report: what its models leave of distances without noise."""
    from benchmarks.renewed.remains import measure, waiting

    names = waiting(out)
    same = list(tqdm(measure(out, names, jobs), "remains", len(names), unit=""))
    if other := same.count(False):
        click.echo(f"{other} name other effects than their reports; no truth for these.", err=True)


@group.command("score")
@steps.OUT
@_jobs
def score_command(out: Path, jobs: int) -> None:
    """Open the answers, check their seals, score, and write the tables."""
    from benchmarks.renewed.tables import write_tables

    click.echo(write_tables(steps.answered(out, jobs), out))


@group.command("all")
@steps.SEED
@_cases
@_tiers
@steps.OUT
@_jobs
@steps.LIMIT
@click.pass_context
def all_command(context: click.Context, /, **options: object) -> None:
    """Generate, diagnose, measure what remains, and score."""
    commands = (generate_command, diagnose_command, remains_command, score_command)
    steps.in_turn(context, commands, options)


if __name__ == "__main__":
    group()
