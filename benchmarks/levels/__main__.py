"""How often nothing is called something, and how often intervals hold the truth.

    python -m benchmarks.levels --seed S --cases nothing:400,effect:60,outside:20 --out FILE.jsonl

Recordings of the renewed generator (`benchmarks/renewed`): its sensors, filters, robots, masks and
forms, but small images and few frames, so that a diagnosis without its page takes a second or two.
A run that was interrupted goes on where it stopped. The tables are printed at the end.
"""

import json
import os
import tempfile
from pathlib import Path

import click
from tqdm import tqdm

from benchmarks.withheld import steps
from benchmarks.withheld.counts import counts_by_name

os.environ.setdefault("OMP_NUM_THREADS", "1")


@click.command(context_settings={"help_option_names": ["-h", "--help"]})
@steps.SEED
@click.option("--cases", default="nothing:400,effect:60,outside:20", show_default=True)
@click.option("--out", type=click.Path(path_type=Path), required=True, help="A line a recording.")
def main(seed: int, cases: str, out: Path) -> None:
    """Diagnose small recordings and print levels and coverage."""
    from benchmarks.levels.cases import KINDS
    from benchmarks.levels.tables import tables

    counts = counts_by_name(cases, 1, list(KINDS), "kind")
    rows = [json.loads(line) for line in out.read_text().splitlines()] if out.exists() else []
    done = {(row["kind"], row["number"]) for row in rows}
    wanted = [(kind, number) for kind, count in counts.items() for number in range(count)]
    with out.open("a") as file:
        for kind, number in tqdm([key for key in wanted if key not in done], unit=""):
            rows.append(_row(seed, kind, number))
            file.write(json.dumps(rows[-1]) + "\n")
            file.flush()
    asked = [row for row in rows if (row["kind"], row["number"]) in wanted]
    for row in asked:
        if "refused" in row:
            click.echo(f"{row['kind']} {row['number']} is refused: {row['refused']}")
    click.echo(tables([row for row in asked if "refused" not in row]))


def _row(seed: int, kind: str, number: int) -> dict:
    from benchmarks.levels.cases import write_case
    from benchmarks.levels.judged import judge
    from tofcorr.errors import TofcorrError

    with tempfile.TemporaryDirectory() as folder:
        case = write_case(seed, kind, number, Path(folder) / "recording")
        try:
            found = judge(case, Path(folder) / "recording")
        except TofcorrError as error:
            found = {"refused": str(error)}
    return {"kind": kind, "number": number, **found}


if __name__ == "__main__":
    main()
