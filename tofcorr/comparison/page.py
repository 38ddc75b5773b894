"""The page of a comparison, and its picture: held-out errors of models with their intervals."""

from collections.abc import Mapping, Sequence
from math import isfinite
from typing import TYPE_CHECKING

from tofcorr.comparison.statistics import Estimate, Table
from tofcorr.pages.page import page_text

if TYPE_CHECKING:  # Matplotlib takes longer to import than a short fit.
    from matplotlib.figure import Figure


def held_out_figure(
    groups: Mapping[str, Mapping[str, Estimate]], label: str, best: Sequence[str] = ()
) -> "Figure":
    """Draw held-out errors with their 95 % intervals, a panel a group, a row a model.

    Args:
        groups: The errors of each model, millimetres, by what the panels are called.
        label: What the errors are.
        best: The model to be marked in each panel; none where it is empty.
    """
    from tofcorr.pages.drawing import BLUE, STAGES, panels, plain_numbers

    names = list(next(iter(groups.values())))
    figure, found = panels(len(groups) * (1 + len(names) / 4), len(groups))
    for number, (axes, (title, errors)) in enumerate(zip(found, groups.items(), strict=True)):
        for place, (name, one) in enumerate(errors.items()):
            marked = list(best[number : number + 1]) == [name]
            look = {"color": STAGES.get(name, BLUE), "fmt": "D" if marked else "o", "capsize": 3}
            reach = one.half_width if isfinite(one.half_width) else 0.0
            # On a logarithmic axis an interval that reaches zero ends near it.
            ends = [[min(reach, one.mean * (1 - 1 / 50))], [reach]]
            axes.errorbar(one.mean, place, xerr=ends, markersize=7 if marked else 4, **look)
            where = ("axes fraction", "data")
            axes.annotate(f" {one.mean:.2f}", (1, place), xycoords=where, va="center", fontsize=9)
        axes.set_yticks(range(len(errors)), list(errors), fontsize=9)
        axes.invert_yaxis()
        axes.set_xscale("log")
        plain_numbers(axes.xaxis)
        axes.set_title(title, fontsize=10, loc="left")
    found[-1].set_xlabel(label)
    return figure


def render(
    title: str,
    verdicts: Sequence[str],
    figure: "Figure",
    tables: Sequence[Table],
    notes: Sequence[str],
    warnings: Sequence[str],
) -> str:
    """Return the page of a comparison.

    Args:
        title: What was done.
        verdicts: What it says of the models, a sentence or two each.
        figure: See `held_out_figure`.
        tables: The numbers.
        notes: How they were found.
        warnings: What limits them.
    """
    values = {"title": title, "verdicts": verdicts, "tables": tables}
    values |= {"notes": notes, "warnings": warnings}
    return page_text("tofcorr.comparison", "report.html.j2", {"errors": figure}, {}, **values)
