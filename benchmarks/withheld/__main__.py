"""`python -m benchmarks.withheld`: generate, diagnose, score, or all of it."""

from pathlib import Path

import click
from tqdm import tqdm

TIERS = "A,B,C,D,E,F,G,H,I,J"

_out = click.option("--out", type=click.Path(path_type=Path), required=True, help="Folder of the whole check.")
_seed = click.option("--seed", type=click.IntRange(0), required=True, help="Draws the cases.")
_cases = click.option("--cases", type=click.IntRange(1), default=40, show_default=True, help="Cases in a tier.")
_tiers = click.option("--tiers", default=TIERS, show_default=True, help="Tiers; C:400 asks for 400 cases of C.")


def counts_of(tiers: str, cases: int) -> dict[str, int]:
    """Cases of each tier from text such as `A,B,C:400`."""
    counts = {}
    for part in tiers.split(","):
        name, _, number = part.strip().partition(":")
        counts[name] = int(number) if number else cases
    return counts


@click.group(context_settings={"help_option_names": ["-h", "--help"]})
def group() -> None:
    """Check `tofcorr diagnose` on recordings whose effect is withheld from it."""


@group.command("generate")
@_seed
@_cases
@_tiers
@_out
def generate_command(seed: int, cases: int, tiers: str, out: Path) -> None:
    """Write recordings and sealed answers."""
    from benchmarks.withheld.cases import generate

    counts = counts_of(tiers, cases)
    for _ in tqdm(generate(seed, counts, out), desc="recordings", unit=""):
        pass


if __name__ == "__main__":
    group()
