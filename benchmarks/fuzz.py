"""What comes of mutated inputs: of every format that tofcorr reads, and the front of its commands.

    python -m benchmarks.fuzz --count 100000 --seed 1 --out fuzz.json

Each input is a valid file with one to three changes: of bytes, of cells, of keys and values, or of
tensors. It must be refused in one sentence, or be read as what it says. Counted as failures are
tracebacks, processes that die, more than 20 s of CPU, more than 4 GB of memory, messages of several
lines, and inputs that are read as something else than they say: another reader is asked, and files
with a digest must give the same output as before. `--only TARGET --number N` runs one input again
in this process, with its traceback.
"""

import json
import tempfile
import time
import traceback
from pathlib import Path

import click
from tqdm import tqdm

from benchmarks import tiny
from benchmarks.fuzzing import archives, configurations, imports, recordings
from benchmarks.fuzzing.target import Target
from benchmarks.fuzzing.worker import Tally, run_all

_BATCH = 250
"""Attempts in one forked process."""


def all_targets(folder: Path, seed: int) -> list[Target]:
    """Return every target, with the valid files that it mutates in a folder."""
    made = tiny.make(folder, seed)
    others = folder / "others"
    others.mkdir()
    return [
        *recordings.targets(made),
        *archives.targets(made),
        *configurations.targets(made),
        *imports.targets(others, seed),
    ]


def summary(tally: Tally, count: int, seconds: float, seed: int) -> str:
    """Return the line that says it all."""
    failed = {k: n for k, n in sorted(tally.outcomes.items()) if k not in ("refused", "accepted")}
    kinds = ", ".join(f"{name} {number}" for name, number in failed.items()) or "none"
    return (
        f"{count} mutated inputs, seed {seed}, {seconds:.0f} s of CPU: "
        f"refused {tally.outcomes['refused']}, accepted {tally.outcomes['accepted']}, "
        f"failures {sum(failed.values())} ({kinds})."
    )


def again(target: Target, seed: int, number: int, folder: Path) -> None:
    """Run one attempt in this process and print its traceback."""
    import random

    try:
        found = target.attempt(random.Random(f"{seed} {target.name} {number}"), folder)
        click.echo(f"accepted: {found!r}"[:2000])
    except Exception:  # noqa: BLE001 - to look at it
        click.echo(traceback.format_exc())


@click.command()
@click.option("--count", default=100_000, show_default=True, help="Number of inputs.")
@click.option("--seed", default=1, show_default=True)
@click.option("--only", help="Targets whose name begins with this.")
@click.option("--number", type=int, help="With --only: this input alone, with its traceback.")
@click.option("--out", type=click.Path(path_type=Path), help="JSON of all failures.")
def main(count: int, seed: int, only: str | None, number: int | None, out: Path | None) -> None:
    """Mutate, read, count."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        targets = [t for t in all_targets(folder, seed) if t.name.startswith(only or "")]
        if number is not None:
            again(targets[0], seed, number, folder / "others")
            return
        total, tally, done = sum(t.share for t in targets), Tally(), 0
        start = time.process_time() + _children()
        with tqdm(total=count, disable=None) as bar:
            for target in targets:
                own, before = max(1, round(count * target.share / total)), dict(tally.outcomes)
                for first in range(0, own, _BATCH):
                    run_all(target, seed, range(first, min(own, first + _BATCH)), tally)
                    bar.update(min(_BATCH, own - first))
                done += own
                new = {k: n - before.get(k, 0) for k, n in tally.outcomes.items()}
                click.echo(f"{target.name:32} {own:6} {_shown(new)}")
        seconds = time.process_time() + _children() - start
    for failure in tally.failures[:60]:
        click.echo(json.dumps(failure))
    click.echo(summary(tally, done, seconds, seed))
    if out is not None:
        out.write_text(json.dumps({"outcomes": tally.outcomes, "failures": tally.failures}))


def _children() -> float:
    import resource

    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _shown(counts: dict[str, int]) -> str:
    return ", ".join(f"{name} {number}" for name, number in sorted(counts.items()) if number)


if __name__ == "__main__":
    main()
