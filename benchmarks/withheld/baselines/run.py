"""All baselines on all recordings."""

import json
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path

import numpy as np

from benchmarks.withheld.baselines.bayes_information import bayes_information
from benchmarks.withheld.baselines.boosting import boosting
from benchmarks.withheld.baselines.covariates import tabulate
from benchmarks.withheld.baselines.distance_correlation import distance_correlation
from benchmarks.withheld.baselines.two_sample import two_sample
from benchmarks.withheld.reading import read
from benchmarks.withheld.sealing import unseal

BASELINES = {
    "gradient boosting, permutation importance": boosting,
    "distance correlation": distance_correlation,
    "BIC forward selection, pixels independent": bayes_information,
    "classifier two-sample test": two_sample,
}


def choose(out: Path, tiers: Sequence[str], most: int) -> list[str]:
    """Names of main recordings, at most so many of each tier, that the baselines have not seen yet.

    Only the choice looks into the answers; a baseline sees the recording alone.
    """
    entries = json.loads((out / "manifest.json").read_text())["recordings"]
    answers = [unseal(out / "answers" / one["id"], one["answer_sha256"]) for one in entries]
    names = []
    for tier in tiers:
        these = [one for one in answers if one["case"]["tier"] == tier and one["role"] == "main"]
        names += [one["id"] for one in sorted(these, key=lambda one: one["index"])[:most]]
    return [name for name in names if not (out / "baselines" / f"{name}.json").exists()]


def run_baselines(out: Path, names: Sequence[str], workers: int) -> Iterator[str]:
    """Let every baseline see these recordings; yield the names of those done."""
    (out / "baselines").mkdir(exist_ok=True)
    with ProcessPoolExecutor(workers) as pool:
        for done in as_completed([pool.submit(_run_one, out, name) for name in names]):
            yield done.result()


def _run_one(out: Path, name: str) -> str:
    table = tabulate(read(out / "recordings" / name))
    said = {
        title: baseline(table, np.random.default_rng(0)) for title, baseline in BASELINES.items()
    }
    kept = {
        title: {"effects": one.effects, "sets": [sorted(members) for members in one.sets]}
        for title, one in said.items()
    }
    (out / "baselines" / f"{name}.json").write_text(json.dumps(kept))
    return name
