"""What comes of wrong recordings, and whether clean ones are let through.

    python -m benchmarks.faults_in_recordings --draws 5 --clean 200 --seed 1000 --out faults.json
    python -m benchmarks.faults_in_recordings --commands all --draws 1 --clean 0

Each fault is made `--draws` times, each time in a newly simulated recording of the shipped `demo`
camera, and given to `train`, or to each of `--commands`. `benchmarks.wrong_recordings.outcomes`
says what counts as a confident wrong number. Clean recordings are drawn with small images, with
every part of the simulator's sensor at random; with `--shipped N` there are N of each shipped
simulator too, and the real ones of `$TOFCORR_REAL_DATA`. They are looked at as every command does
first.
"""

import tempfile
from collections import Counter
from pathlib import Path
from typing import Any

import click
import numpy as np
import yaml
from tqdm import tqdm

from benchmarks.sealed.scores import table
from benchmarks.timing import write
from benchmarks.wrong_recordings.clean import clean_recordings
from benchmarks.wrong_recordings.outcomes import COMMANDS, KINDS, WRONG, Clean, outcome
from benchmarks.wrong_recordings.parts import Parts
from benchmarks.wrong_recordings.table import FURTHER, TABLE, UNLISTED, Fault
from tofcorr.options import resolve_options
from tofcorr.simulation.options import SimulatorOptions
from tofcorr.simulation.simulator import simulate


def faulty(
    name: str, fault: Fault, number: int, seed: int, clean: list[Clean], commands: tuple[str, ...]
) -> list[dict[str, Any]]:
    """Return what each command makes of one fault, once in every clean recording."""
    found = []
    for draw, one in enumerate(clean):
        wrong = one.folder.with_name(f"{number}_{draw}")
        generator = np.random.default_rng([seed, number, draw])
        fault(Parts.read(one.folder), generator).write(wrong)
        found += [
            outcome(command, wrong, one) | {"fault": name, "command": command, "draw": draw}
            for command in commands
        ]
    return found


def clean_demos(draws: int, seed: int, folder: Path) -> list[Clean]:
    """Simulate the recordings that the faults are made in."""
    found = []
    for draw in range(draws):
        path = folder / f"clean_{draw}"
        options = resolve_options(SimulatorOptions, "demo")
        simulate(options.model_copy(update={"seed": seed + draw}), path)
        truth = yaml.safe_load((path / "truth" / "truth.yaml").read_text(encoding="utf-8"))
        found.append(Clean(path, np.array(truth["tool_from_camera"]), folder / f"run_{draw}"))
    return found


def summary(faults: list[dict[str, Any]], clean: list[dict[str, Any]]) -> str:
    """Return the table of the faults and the counts of the clean recordings."""
    rows = []
    for name, command in dict.fromkeys((one["fault"], one["command"]) for one in faults):
        own = [one for one in faults if (one["fault"], one["command"]) == (name, command)]
        found = Counter(one["outcome"] for one in own)
        counts = [found[kind] or "" for kind in KINDS]
        rows.append((name, command, *counts, own[0]["exit"], own[0]["sentence"][:160]))
    wrong = sum(one["outcome"] in WRONG for one in faults)
    doubted = [f"{one['name']}: {one['headline']}" for one in clean if one["headline"] is not None]
    lines = [
        table(("fault", "command", *KINDS, "exit", "what is said"), rows),
        f"\n{len(faults)} commands on faulty recordings: confident wrong numbers or tracebacks "
        f"{wrong}.",
        f"{len(clean)} clean recordings: false stops {sum(one['stopped'] for one in clean)}, "
        f"false headlines {len(doubted)}.",
        *doubted,
    ]
    if clean:
        cpu = np.array([one["cpu_s"] for one in clean])
        lines += [f"CPU time of a look: median {np.median(cpu):.3f} s, largest {cpu.max():.3f} s."]
    return "\n".join(lines)


@click.command()
@click.option("--draws", default=5, show_default=True, help="Recordings of each fault.")
@click.option("--clean", default=200, show_default=True, help="Clean recordings.")
@click.option("--shipped", default=0, help="Clean recordings of each shipped simulator.")
@click.option("--seed", default=1000, show_default=True)
@click.option("--only", default="", help="Only faults whose name contains this.")
@click.option("--commands", default="train", show_default=True, help="Comma-separated, or `all`.")
@click.option("--out", type=click.Path(path_type=Path), help="JSON file for every outcome.")
def main(
    draws: int, clean: int, shipped: int, seed: int, only: str, commands: str, out: Path | None
) -> None:
    """Make every fault, give it to the commands, and print the table."""
    every = TABLE | FURTHER | UNLISTED
    chosen = {name: fault for name, fault in every.items() if only in name}
    asked = tuple(COMMANDS) if commands == "all" else tuple(commands.split(","))
    faults: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as folder:
        demos = clean_demos(draws, seed, Path(folder))
        for number, (name, fault) in enumerate(tqdm(chosen.items(), desc="faults", disable=None)):
            faults += faulty(name, fault, number, seed, demos, asked)
        let_through = clean_recordings(clean, shipped, seed, Path(folder))
    click.echo(summary(faults, let_through))
    write({"faults": faults, "clean": let_through}, out)


if __name__ == "__main__":
    main()
