"""What is left of files when commands are killed, or the disk is full, or a copy was cut short.

    python -m benchmarks.faults --kills 1000 --seed 1 --out faults.json

Every command runs on a tiny recording, in a process forked from this one; each is killed equally
often. It is ended by SIGKILL, SIGTERM or SIGINT: half of the times at a moment drawn from its own
whole duration, half of the times at one of its operations on files. Then

- what was there before must be there unchanged; a file that the command replaces is old or new;
- at the place of its output there is nothing, or all of it: a reader of that format is asked;
- after SIGTERM and SIGINT no temporary file is left; after SIGKILL the next run removes it;
- a run again, for every third kill, succeeds; an interrupted training goes on with `--resume`.

A full disk is a small file system in memory where this process may mount one, a limit on the size
of files, and a failure of every new file from some operation on. Copies of all outputs are cut at a
random length: readers must refuse them, or read the same.
"""

import json
import random
import subprocess
import tempfile
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import click
import torch
from tqdm import tqdm

from benchmarks.killing.commands import commands, prepare
from benchmarks.killing.trial import Trial
from benchmarks.killing.truncated import cut_copies


@contextmanager
def small_disk(place: Path) -> Iterator[Path | None]:
    """Mount a file system of 2 MB in memory; None where that is not allowed."""
    disk = place / "disk"
    disk.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=2m", "tmpfs", str(disk)]
    done = subprocess.run(mount, capture_output=True, check=False)
    try:
        yield None if done.returncode else disk
    finally:
        if not done.returncode:
            subprocess.run(["umount", str(disk)], check=False)


@click.command()
@click.option("--kills", default=1000, show_default=True, help="Number of runs that are killed.")
@click.option("--full", default=150, show_default=True, help="Runs on a full disk.")
@click.option("--cuts", default=2000, show_default=True, help="Copies that are cut short.")
@click.option("--seed", default=1, show_default=True)
@click.option("--only", help="Commands whose name begins with this.")
@click.option("--out", type=click.Path(path_type=Path), help="JSON of all failures.")
def main(kills: int, full: int, cuts: int, seed: int, only: str | None, out: Path | None) -> None:
    """Kill, look, run again; count."""
    # A copy of a process waits forever for the OpenMP threads that this one has.
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as name:
        place, generator = Path(name), random.Random(seed)
        # Scratch folders of these runs, and of no others, are looked for.
        tempfile.tempdir = str(place / "scratch")
        (place / "scratch").mkdir()
        (place / "ready").mkdir()
        prepare(place / "ready", seed)
        among = [one for one in commands() if one.name.startswith(only or "")]
        if not among:
            raise click.BadParameter(
                f"no command's name begins with {only!r}: {', '.join(c.name for c in commands())}.",
                param_hint="--only",
            )
        trial = Trial(place / "ready", place, generator)
        for one in among:
            trial.measure(one)
        killed: Counter[str] = Counter()
        for number in tqdm(range(kills), unit="kill", disable=None):
            command = among[number % len(among)]
            killed[command.name] += 1
            trial.kill(command)
            if number % 25 == 24:
                click.echo(f"{number + 1} kills so far: failures {len(trial.failures)}")
        # The quick ones, where there is a choice.
        quick = [one for one in among if trial.whole[one.name].seconds < 8] or among
        with small_disk(place) as disk:
            for _ in tqdm(range(full), unit="full disk", disable=None):
                trial.fill(generator.choice(quick), disk)
        texts, binary = cut_copies(place / "ready", cuts, generator) if cuts else ([], [])
    _tell(trial, killed, (texts, binary), (kills, full, cuts, seed), out)


def _tell(
    trial: Trial,
    killed: Counter[str],
    cut: tuple[list[str], list[str]],
    asked: tuple[int, int, int, int],
    out: Path | None,
) -> None:
    for command, number in sorted(killed.items()):
        click.echo(f"{command:40} {number} killed")
    click.echo(", ".join(f"{name}: {number}" for name, number in sorted(trial.outcomes.items())))
    for sentence in (cut[0] + cut[1])[:20]:
        click.echo(sentence)
    kills, full, cuts, seed = asked
    click.echo(
        f"{kills} kills and {full} full disks over {len(killed)} commands, seed {seed}: failures "
        f"{len(trial.failures)}. {cuts} copies cut short: binary ones taken for whole "
        f"{len(cut[1])}, texts read as something else {len(cut[0])}."
    )
    if out is not None:
        values = {"outcomes": trial.outcomes, "failures": trial.failures, "cut": cut}
        out.write_text(json.dumps(values), encoding="utf-8")


if __name__ == "__main__":
    main()
