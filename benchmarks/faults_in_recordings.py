"""What comes of wrong recordings, and whether clean ones are let through.

    python -m benchmarks.faults_in_recordings --draws 5 --clean 200 --seed 1000 --out faults.json
    python -m benchmarks.faults_in_recordings --table --commands all --draws 1 --clean 0

Each fault is made `--draws` times, each time in a newly simulated recording of the shipped `demo`
camera, and given to `train`, or to each of `--commands`. `benchmarks.wrong_recordings.outcomes`
says what counts as a confident wrong number. Clean recordings are drawn with small images, with
every part of the simulator's sensor at random; with `--shipped N` there are N of each shipped
simulator too, and the real ones of `$TOFCORR_REAL_DATA`. They are looked at as every command does
first.
"""

import json
import tempfile
from pathlib import Path
from typing import Any

import click
import numpy as np
import yaml
from tqdm import tqdm

from benchmarks.wrong_recordings.clean import clean_recordings
from benchmarks.wrong_recordings.outcomes import COMMANDS, Clean, looked_at_once, outcome
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
        with looked_at_once():
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
    kinds = [
        "stopped",
        "do not use",
        "headline",
        "within its errors",
        "confident and wrong",
        "traceback",
    ]
    lines = ["| fault | command | " + " | ".join(kinds) + " | exit | what is said |"]
    lines.append("|---|---|" + "---:|" * 7 + "---|")
    for name, command in dict.fromkeys((one["fault"], one["command"]) for one in faults):
        own = [one for one in faults if (one["fault"], one["command"]) == (name, command)]
        counts = [str(sum(one["outcome"] == kind for one in own) or "") for kind in kinds]
        cells = [name, command, *counts, str(own[0]["exit"]), own[0]["sentence"][:160]]
        lines.append(f"| {' | '.join(cells)} |")
    stops = sum(one["stopped"] for one in clean)
    headlines = sum(one["headline"] is not None for one in clean)
    wrong = sum(one["outcome"] in ("confident and wrong", "traceback") for one in faults)
    lines.append(
        f"\n{len(faults)} commands on faulty recordings: confident wrong numbers or tracebacks "
        f"{wrong}.\n"
        f"{len(clean)} clean recordings: false stops {stops}, false headlines {headlines}."
    )
    if clean:
        cpu = np.array([one["cpu_s"] for one in clean])
        lines += [f"{one['name']}: {one['headline']}" for one in clean if one["headline"]]
        lines.append(
            f"CPU time of a look: median {np.median(cpu):.3f} s, largest {cpu.max():.3f} s."
        )
    return "\n".join(lines)


@click.command()
@click.option("--draws", default=5, show_default=True, help="Recordings of each fault.")
@click.option("--clean", default=200, show_default=True, help="Clean recordings.")
@click.option("--shipped", default=0, help="Clean recordings of each shipped simulator.")
@click.option("--seed", default=1000, show_default=True)
@click.option("--only", help="Only faults whose name contains this.")
@click.option("--table", "only_table", is_flag=True, help="Only the rows of the table of issue 16.")
@click.option("--commands", default="train", show_default=True, help="Comma-separated, or `all`.")
@click.option("--out", type=click.Path(path_type=Path), help="JSON file for every outcome.")
def main(
    draws: int,
    clean: int,
    shipped: int,
    seed: int,
    only: str | None,
    only_table: bool,
    commands: str,
    out: Path | None,
) -> None:
    """Make every fault, give it to the commands, and print the table."""
    every = TABLE if only_table else TABLE | FURTHER | UNLISTED
    chosen = {name: f for name, f in every.items() if not only or only in name}
    asked = COMMANDS if commands == "all" else tuple(commands.split(","))
    faults: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as folder:
        demos = clean_demos(draws, seed, Path(folder))
        for number, (name, fault) in enumerate(tqdm(chosen.items(), desc="faults", disable=None)):
            faults += faulty(name, fault, number, seed, demos, asked)
        let_through = clean_recordings(clean, shipped, seed, Path(folder))
    click.echo(summary(faults, let_through))
    if out is not None:
        text = json.dumps({"faults": faults, "clean": let_through}, indent=1)
        out.write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
