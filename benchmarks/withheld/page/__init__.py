"""The page: scores, confusion matrix, power curves, comparison, failures worth learning from."""

import base64
import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import jinja2

from benchmarks.withheld.outcomes import Outcome
from benchmarks.withheld.page.failures import Failure, failures
from benchmarks.withheld.page.figures import confusion, failure_figure, power
from benchmarks.withheld.scoring import score_all
from benchmarks.withheld.scoring.comparison import ahead, compare
from benchmarks.withheld.scoring.figures import Score

TEMPLATES = Path(__file__).parent / "templates"
SHOWN = 6  # failures with a figure


def write_page(outcomes: Sequence[Outcome], out: Path, title: str) -> list[Score]:
    """Write `page.html`, `page.md`, `scores.json` and `figures/` into `out`; return the scores."""
    scores, rows = score_all(outcomes), compare(outcomes, out)
    wrong = failures(outcomes)
    figures = _figures(outcomes, wrong, out)
    context = {
        "title": title,
        "scores": scores,
        "rows": rows,
        "ahead": ahead(rows) if rows else None,
        "failures": wrong,
        "figures": figures,
        "recordings": len(outcomes),
    }
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(TEMPLATES),
        autoescape=jinja2.select_autoescape(["html.j2"]),
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    environment.filters |= {"figure": _number, "inline": lambda name: _inline(out / name)}
    for name in ("page.html", "page.md"):
        (out / name).write_text(environment.get_template(f"{name}.j2").render(context))
    kept: dict[str, Any] = {
        "format": "tofcorr-withheld-scores",
        "scores": [asdict(one) for one in scores],
    }
    (out / "scores.json").write_text(json.dumps(kept, indent=1))
    return scores


def _figures(outcomes: Sequence[Outcome], wrong: Sequence[Failure], out: Path) -> dict[str, str]:
    """Figures by name, as paths below `out`."""
    (out / "figures").mkdir(exist_ok=True)
    made: dict[str, str] = {}
    for name, figure in (("confusion", confusion(outcomes)), ("power", power(outcomes))):
        if figure is not None:
            figure.savefig(out / "figures" / f"{name}.png", dpi=110, bbox_inches="tight")
            made[name] = f"figures/{name}.png"
    for failure in [one for one in wrong if one.outcome.truths][:SHOWN]:
        name = failure.outcome.name
        figure = failure_figure(failure.outcome, out)
        figure.savefig(out / "figures" / f"{name}.png", dpi=90, bbox_inches="tight")
        made[name] = f"figures/{name}.png"
    return made


def _number(value: float, digits: int = 2) -> str:
    return "–" if value != value else f"{value:.{digits}f}"  # noqa: PLR0124 - NaN differs from itself


def _inline(file: Path) -> str:
    return "data:image/png;base64," + base64.b64encode(file.read_bytes()).decode()
