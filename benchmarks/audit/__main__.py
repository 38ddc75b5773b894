"""Every case of the audit's table, made anew: what is true, and what the diagnosis says.

    python -m benchmarks.audit --seed S --out FILE.jsonl
    python -m benchmarks.audit --seed S --rows height:5,robot --out FILE.jsonl

Recordings come from the renewed generator (`benchmarks/renewed`), with its light, its sensor and
the base errors of its cameras; what a row needs beyond that is added here. A line is printed for
each, and kept in FILE; a run that was interrupted goes on where it stopped. Rooms need the
renderer (`benchmarks/renewed/README.md`).
"""

import json
import os
import tempfile
from pathlib import Path
from typing import Any

import click

from benchmarks.withheld import steps

os.environ.setdefault("OMP_NUM_THREADS", "1")


@click.command(context_settings={"help_option_names": ["-h", "--help"]})
@steps.SEED
@click.option("--rows", default="", help="Rows to draw, and how many of each; all if empty.")
@click.option("--out", type=click.Path(path_type=Path), required=True, help="A line a recording.")
def main(seed: int, rows: str, out: Path) -> None:
    """Diagnose the recordings of each row and judge the answers."""
    from benchmarks.audit.rows import ROWS
    from benchmarks.audit.tables import line, table
    from benchmarks.withheld.counts import counts_by_name

    counts = {name: row.draws for name, row in ROWS.items()}
    if rows:
        asked = counts_by_name(rows, 0, list(ROWS), "row")
        counts = {name: count or counts[name] for name, count in asked.items()}
    kept = [json.loads(text) for text in out.read_text().splitlines()] if out.exists() else []
    done = {(one["row"], one["number"]): one for one in kept}
    shown = []
    with out.open("a") as file:
        for name, number in ((name, k) for name, count in counts.items() for k in range(count)):
            if (name, number) not in done:
                done[name, number] = _draw(seed, name, number)
                file.write(json.dumps(done[name, number]) + "\n")
                file.flush()
            shown.append(done[name, number])
            click.echo(line(shown[-1]))
    click.echo(table(shown))


def _draw(seed: int, name: str, number: int) -> dict[str, Any]:
    from benchmarks.audit.judged import judge
    from benchmarks.audit.rows import write_draw

    with tempfile.TemporaryDirectory() as folder:
        recording = Path(folder) / "recording"
        made = write_draw(seed, name, number, recording)
        return {"row": name, "number": number, **judge(name, made, recording)}


if __name__ == "__main__":
    main()
