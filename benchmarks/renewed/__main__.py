"""`python -m benchmarks.renewed`: generate, diagnose, remains, score, or all of it."""

import os
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import click
from tqdm import tqdm

from benchmarks.withheld.counts import counts_by_name

# Processes share the work; threads inside each would only wait for one another.
os.environ.setdefault("OMP_NUM_THREADS", "1")

TIERS = "E,N,O"
REAL = "K"  # needs $TOFCORR_REAL_DATA; its number of cases is fixed
CONFIG = "simulate_anew: false\npage: false\n"

_out = click.option("--out", type=click.Path(path_type=Path), required=True, help="Folder of all.")
_seed = click.option("--seed", type=click.IntRange(0), required=True, help="Draws the cases.")
_cases = click.option(
    "--cases", type=click.IntRange(1), default=59, show_default=True, help="Cases in a tier."
)
_tiers = click.option(
    "--tiers", default=TIERS, show_default=True, help="Tiers; N:400 asks for 400 cases of N."
)
_jobs = click.option("--jobs", type=click.IntRange(1), default=2, show_default=True)
_limit = click.option(
    "--limit", "limit_s", default=300.0, show_default=True, help="Seconds for one recording."
)


@click.group(context_settings={"help_option_names": ["-h", "--help"]})
def group() -> None:
    """Check `tofcorr diagnose` on recordings that nobody tuned it on."""


@group.command("generate")
@_seed
@_cases
@_tiers
@_out
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
@_out
@_jobs
@_limit
def diagnose_command(out: Path, jobs: int, limit_s: float) -> None:
    """Run `tofcorr diagnose` on the recordings alone; go on where it was interrupted."""
    from benchmarks.withheld.diagnose import waiting

    _run(out, waiting(out), jobs, limit_s, "diagnoses")


@group.command("remains")
@_out
@_jobs
@_limit
def remains_command(out: Path, jobs: int, limit_s: float) -> None:
    """Measure what the effects named leave, on the same recordings without noise."""
    from benchmarks.renewed.remains import named_again

    _run(out, named_again(out), jobs, limit_s, "remains")


def _run(out: Path, entries: list[dict], jobs: int, limit_s: float, what: str) -> None:
    from benchmarks.withheld.diagnose import Plan, diagnose

    failed = 0
    with tqdm(
        diagnose(out, entries, Plan(jobs, limit_s, CONFIG)), what, len(entries), unit=""
    ) as runs:
        for _, code in runs:
            failed += code != 0
            runs.set_postfix(failed=failed)


@group.command("score")
@_out
@_jobs
def score_command(out: Path, jobs: int) -> None:
    """Open the answers, check their seals, score, and write the tables."""
    from benchmarks.renewed.tables import write_tables
    from benchmarks.withheld.outcomes import open_answers

    with ProcessPoolExecutor(jobs) as pool:
        outcomes = list(tqdm(open_answers(out, pool.map), desc="answers", unit=""))
    left = sum(one.said.failure == "not run" for one in outcomes)
    if left:
        click.echo(f"{left} of {len(outcomes)} recordings are not diagnosed; left out.", err=True)
    run = [one for one in outcomes if one.said.failure != "not run"]
    click.echo(write_tables(run, out))


@group.command("all")
@_seed
@_cases
@_tiers
@_out
@_jobs
@_limit
@click.pass_context
def all_command(context: click.Context, /, **options: object) -> None:
    """Generate, diagnose, measure what remains, and score."""
    for command in (generate_command, diagnose_command, remains_command, score_command):
        wanted = {parameter.name for parameter in command.params}
        context.invoke(command, **{key: value for key, value in options.items() if key in wanted})


if __name__ == "__main__":
    group()
