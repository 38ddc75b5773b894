"""All baselines on all recordings."""

import json
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path

import numpy as np

from benchmarks.withheld.baselines.bayes_information import bayes_information
from benchmarks.withheld.baselines.boosting import boosting
from benchmarks.withheld.baselines.covariates import tabulate
from benchmarks.withheld.baselines.distance_correlation import distance_correlation
from benchmarks.withheld.baselines.two_sample import two_sample
from benchmarks.withheld.reading import read

BASELINES = {
    "gradient boosting, permutation importance": boosting,
    "distance correlation": distance_correlation,
    "BIC forward selection, pixels independent": bayes_information,
    "classifier two-sample test": two_sample,
}


def run_baselines(out: Path, workers: int) -> Iterator[str]:
    """Let the baselines see the recordings they have not seen yet; yield each name."""
    (out / "baselines").mkdir(exist_ok=True)
    entries = json.loads((out / "manifest.json").read_text())["recordings"]
    names = [entry["id"] for entry in entries if not entry["exclude"]]
    waiting = [name for name in names if not (out / "baselines" / f"{name}.json").exists()]
    with ProcessPoolExecutor(workers) as pool:
        for done in as_completed([pool.submit(_run_one, out, name) for name in waiting]):
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
