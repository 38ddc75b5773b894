"""How often nothing is called something, and how often intervals hold the truth.

    python -m benchmarks.levels --seed S --cases nothing:400,effect:60,outside:20 --out FILE.jsonl

Recordings of the renewed generator (`benchmarks/renewed`): its sensors, filters, robots, masks and
forms, but small images and few frames, so that a diagnosis without its page takes a second or two.
Forms that need a renderer are left out. A run that was interrupted goes on where it stopped. The
true gaps are those of `benchmarks.sealed.remains`; the oracle's gap before, with all pixels alike,
stands beside them.
"""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from itertools import pairwise
from pathlib import Path
from typing import Any

import click
import numpy as np

from benchmarks.renewed import ranges
from benchmarks.renewed.cases import Case, agree, make_case, turn
from benchmarks.renewed.forms import INSIDE, OUTSIDE
from benchmarks.renewed.recording import read, write_recording
from benchmarks.renewed.signal_chain import Form
from benchmarks.sealed.command import OUT, SEED, counts_by_name, kept_rows
from benchmarks.sealed.oracle import ask
from benchmarks.sealed.scores import by_design, known, share, table
from tofcorr.simulation.effects import CATALOGUE

Row = Mapping[str, Any]
KINDS = ("nothing", "effect", "outside", "pair")
IMAGES = {(32, 24): 0.6, (48, 36): 0.4}
FRAMES = {
    "nothing": {15: 0.06, 20: 0.06, 30: 0.22, 45: 0.3, 60: 0.36},
    "effect": {15: 0.06, 20: 0.06, 30: 0.14, 45: 0.3, 60: 0.44},
}
OUTSIDE_MM = ranges.Range(3.0, 6.0)
# What is rendered would take longer than its diagnosis.
FORMS = tuple(one for one in INSIDE if one.effect != "multipath" and "slab" not in one.name)
EDGE_MM = 5e-4  # of a report: three digits
GAPS = ("before", "after", "closed")


def small_images(kind: str) -> AbstractContextManager[None]:
    """Draw small images and few frames; everything else is as in the renewed check."""
    frames = FRAMES["nothing" if kind == "nothing" else "effect"]
    return ranges.drawn_from(images=IMAGES, frames=frames)


def write_case(seed: int, kind: str, number: int, folder: Path) -> Case:
    """Write one recording; it depends on seed, kind and number alone."""
    forms = _forms_of(seed, kind, number)
    letters = sum(sum(map(ord, form.effect + form.name)) for form in forms)
    rng = np.random.default_rng([seed, *([0, number, letters] if forms else [1, number])])
    with small_images(kind):
        case = make_case(rng, forms, OUTSIDE_MM if kind == "outside" else ranges.RANGES["sizes_mm"])
    write_recording(folder, case.recorded)
    return case


def _forms_of(seed: int, kind: str, number: int) -> tuple[Form, ...]:
    """The form whose turn it is; two effects are drawn until one design can show both."""
    if kind == "nothing":
        return ()
    if kind != "pair":
        return (turn(seed, OUTSIDE if kind == "outside" else FORMS, number),)
    rng = np.random.default_rng([seed, 2, number])
    while True:
        forms = tuple(FORMS[i] for i in rng.choice(len(FORMS), 2, replace=False))
        if agree(forms):
            return forms


def judge(case: Case, folder: Path) -> dict[str, Any]:
    """Return what is true of a case and what the diagnosis says, in this process."""
    from benchmarks.sealed.remains import diagnosed, true_gaps_mm

    data = read(folder)
    start = time.process_time()
    study, named, gap, left = diagnosed(folder)
    seconds = time.process_time() - start
    oracle = ask(data, case.truth.fields, case.truth.expected)
    before, after = true_gaps_mm(study, named, data.depth - case.truth.expected)
    true = {"before": before, "after": after, "closed": max(1 - (after / before) ** 2, 0.0)}
    said = {
        "before": [1e3 * x for x in gap.before.interval],
        "after": [1e3 * x for x in gap.after.interval],
        "closed": list(gap.closed.interval),
    }
    held = {
        name: said[name][0] - EDGE_MM <= value <= said[name][1] + EDGE_MM
        for name, value in true.items()
    }
    return {
        **case.described(),
        "sizes_mm": case.sizes_mm,
        "must_find": [name for name in case.truth.fields if oracle.must_find(name)],
        "names": named.names,
        "sets": named.cause_sets,
        "tested": named.tested,
        "unknown": left.unknown,
        "probabilities": named.probabilities,
        "unknown_probability": named.unknown,
        "gap_mm": {"before": 1e3 * gap.before, "after": 1e3 * gap.after, "floor": 1e3 * gap.floor},
        "closed": gap.closed,
        "intervals": said,
        "truth": true,
        "before_all_alike_mm": oracle.before_mm,
        "held": held,
        "seconds": seconds,
    }


SAID: dict[str, Callable[[Row], bool]] = {
    "named": lambda row: bool(row["names"]),
    "unknown": lambda row: row["unknown"],
    "detected": lambda row: row["tested"] and (bool(row["names"]) or row["unknown"]),
}
BINS = (0.05, 0.2, 0.4, 0.6, 0.8, 0.95, 1.0)  # ends of what is stated alike


def tables(rows: Sequence[Row]) -> str:
    """Return all tables as Markdown: levels by what was drawn, effects, coverage."""
    nothing = [row for row in rows if row["kind"] == "nothing"]
    made = _levels(nothing) if nothing else "", _found(rows), _reliability(rows), _coverage(rows)
    return "\n\n".join(filter(None, made))


def _levels(rows: Sequence[Row]) -> str:
    lines: list[tuple[object, ...]] = []
    for what, some in (("all", rows), ("tested", [row for row in rows if row["tested"]])):
        lines.append((what, "", len(some), *(share(map(of, some)) for of in SAID.values())))
    lines += by_design([(row, [of(row) for of in SAID.values()]) for row in rows])
    return table(("nothing missing", "", "n", *SAID), lines)


def _reliability(rows: Sequence[Row]) -> str:
    """Of the effects of the catalogue stated at some probability, what share is there."""
    stated: list[tuple[float, bool]] = []
    for row in rows:
        there = known(row["sizes_mm"])
        said = [(name, own) for name, own in row["probabilities"].items() if name in CATALOGUE]
        stated += [(own, bool(known([name]) & there)) for name, own in said]
    if not stated:
        return ""
    probability, true = np.array(stated).T
    lines = [("Brier score", len(true), f"{np.mean((probability - true) ** 2):.4f}", "")]
    for low, high in pairwise(BINS):
        own = (probability >= low) & (probability <= high)
        if own.any():
            there = str(share(map(bool, true[own])))
            said = f"{probability[own].mean():.3f}"
            lines.append((f"{low:g} to {high:g}", int(own.sum()), there, said))
    return table(("effects stated at", "n", "are there", "stated, mean"), lines)


def _found(rows: Sequence[Row]) -> str:
    """Of the effects of each kind that an oracle finds: what is said of them."""
    lines = []
    for kind in KINDS[1:]:
        some = [row for row in rows if row["kind"] == kind and row["must_find"]]
        asked = [(row, name) for row in some for name in row["must_find"]]
        held = [any(name in known(own) for own in row["sets"]) for row, name in asked]
        either = [inside or row["unknown"] for inside, (row, _) in zip(held, asked, strict=True)]
        wrong = [
            any(len(own) == 1 and not known(own) & set(row["sizes_mm"]) for own in row["sets"])
            for row in some
        ]
        judged = held, either, wrong, [row["unknown"] for row in some], map(SAID["detected"], some)
        sizes = [len(own) for row in some for own in row["sets"]]
        size = f"{np.mean(sizes):.2f}" if sizes else ""
        lines += [(kind, len(some), *map(share, judged), size)] if some else []
    said = "in a set", "in a set or unknown", "a single wrong name", "unknown", "detected"
    return table(("findable effects", "n", *said, "size of a set"), lines)


def _coverage(rows: Sequence[Row]) -> str:
    groups = {"all": rows} | {k: [row for row in rows if row["kind"] == k] for k in KINDS}
    for low, high in ((0, 16), (16, 32), (32, math.inf)):
        some = [row for row in rows if low <= row["design"]["poses"] < high]
        groups[f"{low} poses or more"] = some
    lines = []
    for name, some in groups.items():
        held = [share(row["held"][gap] for row in some) for gap in GAPS]
        before = [(row["intervals"]["before"], row["before_all_alike_mm"]) for row in some]
        alike = share(low <= value <= high for (low, high), value in before)
        lines += [(name, len(some), *held, alike)] if some else []
    head = ("95 % intervals hold the truth", "n", *GAPS, "before, all pixels alike")
    return table(head, lines)


@click.command(context_settings={"help_option_names": ["-h", "--help"]})
@SEED
@click.option("--cases", default="nothing:400,effect:60,outside:20", show_default=True)
@OUT
def main(seed: int, cases: str, out: Path) -> None:
    """Diagnose small recordings, write a line for each, and print levels and coverage."""
    from tofcorr.errors import TofcorrError

    def make(kind: str, number: int, folder: Path) -> dict[str, Any]:
        case = write_case(seed, kind, number, folder)
        try:
            return judge(case, folder)
        except TofcorrError as error:
            return {"refused": str(error)}

    rows = list(kept_rows(out, counts_by_name(cases, 1, list(KINDS), "kind"), make))
    for row in rows:
        if "refused" in row:
            click.echo(f"{row['kind']} {row['number']} is refused: {row['refused']}")
    click.echo(tables([row for row in rows if "refused" not in row]))


if __name__ == "__main__":
    main()
