"""The choice of a model as JSON, as text and as Markdown."""

from typing import Any

from tofcorr.comparison.comparability import comparability_notes
from tofcorr.comparison.comparison_options import masks_of
from tofcorr.comparison.ranking import Ranking
from tofcorr.comparison.selection import HeldOutRankings
from tofcorr.comparison.selection_options import SelectionOptions
from tofcorr.comparison.table import Table

_HEADINGS = {
    "image": "Images held out",
    "distance": "Bands of distance held out",
    "target": "Targets held out",
}


def selection_mapping(found: HeldOutRankings, options: SelectionOptions) -> dict[str, Any]:
    """Return the choice as plain values."""
    decisive = found.decisive
    return {
        "format": "tofcorr-selection",
        "version": 1,
        "metric": options.metric,
        "winner": decisive.winner,
        "ties": decisive.ties,
        "verdict": verdict(found),
        "by": {
            by: {
                "held_out": {name: len(frames) for name, frames in found.held_out[by].items()},
                "best": ranking.best,
                "winner": ranking.winner,
                "ties": ranking.ties,
                "models": {
                    name: {
                        "unknowns": one.complexity,
                        "error_mm": one.error,
                        "error_se_mm": _or_none(one.standard_error),
                        "behind_best_mm": one.behind,
                        "behind_best_se_mm": _or_none(one.behind_standard_error),
                        "behind_best_ci95_mm": [_or_none(end) for end in one.interval],
                    }
                    for name, one in ranking.models.items()
                },
            }
            for by, ranking in found.rankings.items()
        },
        "measured_on": masks_of(options).to_mapping() | {"planes": options.planes},
        "notes": comparability_notes(options),
        "skipped": dict(found.skipped),
        "left_out": found.left_out,
        "warnings": found.warnings,
    }


def verdict(found: HeldOutRankings) -> str:
    """Return the choice in one paragraph."""
    (first, decisive), *others = found.rankings.items()
    winner = decisive.models[decisive.winner]
    text = (
        f"{decisive.winner} is the choice ({winner.error:.2f} mm on {first}s held out): the "
        "simplest model within one standard error of the best"
    )
    text += "." if decisive.best == decisive.winner else f", {decisive.best}."
    if decisive.ties:
        text += f" Not significantly different from it: {', '.join(decisive.ties)}."
    for by, ranking in others:
        lost = decisive.winner != ranking.winner and decisive.winner not in ranking.ties
        if lost:
            one = ranking.models[decisive.winner]
            text += (
                f" With {by}s held out {ranking.winner} is better: {decisive.winner} is "
                f"{one.behind:.2f} mm behind the best there."
            )
    return text


def selection_text(found: HeldOutRankings, options: SelectionOptions) -> str:
    """Return the choice, a table for each grouping, notes and warnings, for a terminal."""
    blocks = [verdict(found), *(table.text() for table in tables(found, options))]
    return "\n\n".join([*blocks, *_notes(found, options)])


def selection_markdown(
    found: HeldOutRankings, options: SelectionOptions, headline: str | None = None
) -> str:
    """Return the same as a page of Markdown."""
    blocks = ["# Choice of a model", *([headline] if headline else []), verdict(found)]
    blocks += [table.markdown() for table in tables(found, options)]
    return "\n\n".join([*blocks, *_notes(found, options)]) + "\n"


def tables(found: HeldOutRankings, options: SelectionOptions) -> list[Table]:
    """Return a table for each grouping, the model with the smallest error first."""
    metric = {"mean_abs": "mean absolute", "rms": "RMS"}[options.metric]
    return [
        Table(
            f"{_HEADINGS[by]}: {metric} error, mm",
            ["model", "unknowns", "error", "behind the best", ""],
            _rows(ranking),
            f"Held out in turn: {'; '.join(found.held_out[by])}.",
        )
        for by, ranking in found.rankings.items()
    ]


def _rows(ranking: Ranking) -> list[list[str]]:
    rows = []
    for name, one in sorted(ranking.models.items(), key=lambda item: item[1].error):
        low, high = one.interval
        rows.append(
            [
                name,
                str(one.complexity),
                f"{one.error:.2f} ± {one.standard_error:.2f}",
                "best" if name == ranking.best else f"{one.behind:.2f} [{low:.2f}, {high:.2f}]",
                "winner" if name == ranking.winner else "tie" if name in ranking.ties else "",
            ]
        )
    return rows


def _notes(found: HeldOutRankings, options: SelectionOptions) -> list[str]:
    return [
        *comparability_notes(options),
        *(f"Not held out by {by}: {why}" for by, why in found.skipped.items()),
        *(f"Warning: {warning}" for warning in found.warnings),
        "Errors are distances to the plane, each pose held out once, mean over the poses ± one "
        "standard error. Behind the best: paired difference, pose by pose, with its 95 % interval.",
    ]


def _or_none(value: float) -> float | None:
    """Return None for infinity, which JSON does not have."""
    return value if abs(value) < float("inf") else None
