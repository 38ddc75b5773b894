"""What people would try first, on the same recordings: four ways of finding a cause in the residuals.

All start from the residuals of the same base fit and get the same covariates; a covariate speaks for the effects listed
in `covariates.SPEAKS_FOR`, and the baseline is right if the true effect is among them.
"""

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
from benchmarks.withheld.outcomes import Said
from benchmarks.withheld.reading import read

BASELINES = {
    "gradient boosting, permutation importance": boosting,
    "distance correlation": distance_correlation,
    "BIC forward selection, pixels independent": bayes_information,
    "classifier two-sample test": two_sample,
}


def run_baselines(out: Path, workers: int) -> Iterator[str]:
    """Let every baseline see every recording that it has not seen yet; yield the names of those done."""
    (out / "baselines").mkdir(exist_ok=True)
    entries = json.loads((out / "manifest.json").read_text())["recordings"]
    names = [entry["id"] for entry in entries if not entry["exclude"]]
    waiting = [name for name in names if not (out / "baselines" / f"{name}.json").exists()]
    with ProcessPoolExecutor(workers) as pool:
        for done in as_completed([pool.submit(_run_one, out, name) for name in waiting]):
            yield done.result()


def read_baseline(out: Path, name: str, baseline: str) -> Said | None:
    """What a baseline said of a recording; nothing if it has not seen it."""
    file = out / "baselines" / f"{name}.json"
    if not file.exists():
        return None
    kept = json.loads(file.read_text())[baseline]
    return Said(tuple(kept["effects"]), tuple(frozenset(members) for members in kept["sets"]))


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
