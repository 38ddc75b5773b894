"""The chart of a selection: by how much each model is behind the best."""

import numpy as np
from matplotlib.figure import Figure

from tofcorr.comparison.selection import HeldOutRankings


def ranking_figure(found: HeldOutRankings) -> Figure:
    """Draw each model's distance to the best and its 95 % interval, a panel for each grouping."""
    rankings = found.rankings
    num_models = len(found.decisive.models)
    figure = Figure(
        figsize=(2.0 + 3.2 * len(rankings), 1.6 + 0.35 * num_models), layout="constrained"
    )
    panels = figure.subplots(1, len(rankings), sharey=True, squeeze=False)[0]
    for axes, (by, ranking) in zip(panels, rankings.items(), strict=True):
        for place, (name, one) in enumerate(ranking.models.items()):
            low, high = one.interval
            colour = "C2" if name == ranking.winner else "0.4"
            half_width = high - one.behind if np.isfinite(high - low) else 0.0
            axes.errorbar(one.behind, place, xerr=half_width, fmt="o", color=colour, capsize=3)
        axes.axvline(0.0, color="0.7", linewidth=1, zorder=0)
        axes.set_yticks(np.arange(num_models), list(ranking.models))
        axes.set_title(f"{by}s held out: {ranking.winner} wins", fontsize=10)
        axes.set_xlabel("error minus that of the best [mm]")
    panels[0].invert_yaxis()
    return figure
