"""The table of a run: printed, and kept as JSON."""

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from benchmarks.withheld.pairs.outcomes import PairOutcome
from benchmarks.withheld.scoring.figures import Score


def line(score: Score) -> str:
    """One score in one line of text."""
    if not score.count:
        return f"{score.tier:14s}not measured            {score.what} {score.target}".rstrip()
    low, high = score.interval
    met = {None: "", True: "met", False: "missed"}[score.met]
    figures = f"{score.value:5.2f} [{low:.2f}, {high:.2f}] n={score.count:<4d}"
    return f"{score.tier:14s}{figures} {score.what} {score.target} {met}".rstrip()


def write_scores(scores: Sequence[Score], outcomes: Sequence[PairOutcome], file: Path) -> None:
    """Write all scores, and what was said and true of every pair."""
    pairs = [
        {
            "id": one.outcome.name,
            "kind": one.kind,
            "withheld": one.outcome.answer["case"]["withheld"],
            "shared": one.outcome.answer["case"]["shared"],
            "truth": one.truth,
            "findable": sorted(one.outcome.must_find),
            "failure": one.outcome.said.failure.strip().splitlines()[-1:],
            "seconds": one.outcome.said.seconds,
            "said": {
                key: one.report.get(key)
                for key in (
                    *("stages", "attribution", "effects", "cause_sets", "unknown"),
                    *("noise", "dropouts", "amplitude"),
                )
            },
            "degraded": None if one.degraded is None else asdict(one.degraded),
        }
        for one in outcomes
    ]
    kept = {
        "format": "tofcorr-withheld-pairs",
        "scores": [
            asdict(one) | {"value": one.value if one.count else None, "measured": bool(one.count)}
            for one in scores
        ],
        "pairs": pairs,
    }
    file.write_text(json.dumps(kept, indent=1))
