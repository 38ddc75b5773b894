"""The chart of an evaluation: held-out error of every model on every set."""

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import LogFormatter, ScalarFormatter

from tofcorr.comparison.evaluation import SetEvaluation
from tofcorr.comparison.evaluation_options import EvaluationOptions


def comparison_figure(evaluations: Sequence[SetEvaluation], options: EvaluationOptions) -> Figure:
    """Draw the held-out mean absolute error of each column and set, with its 95 % interval."""
    protocol = "folds" if options.folds else "half"
    columns = options.columns
    figure = Figure(
        figsize=(max(6.0, 1.2 * len(columns) * len(evaluations) ** 0.7), 4.4), layout="constrained"
    )
    axes = figure.subplots()
    group = 0.8 / len(columns)
    for k, column in enumerate(columns):
        found = [one.estimate(protocol, "mean_abs_mm", column) for one in evaluations]
        place = np.arange(len(found)) + (k - (len(columns) - 1) / 2) * group
        means = [estimate.mean for estimate in found]
        spread = np.nan_to_num([estimate.half_width for estimate in found])
        # On a logarithmic axis an interval that reaches zero ends at a fiftieth of its mean.
        down = np.minimum(spread, 0.98 * np.array(means))
        colour = {0: "0.6", 1: "0.35"}.get(k, f"C{k - 2}")
        axes.errorbar(place, means, (down, spread), fmt="o", color=colour, capsize=3, label=column)
        for x, mean in zip(place, means, strict=True):
            axes.annotate(f" {mean:.1f}", (x, mean), fontsize=8, color=colour, va="bottom")
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter(ScalarFormatter())
    axes.yaxis.set_minor_formatter(LogFormatter(minor_thresholds=(2, 0.6)))
    axes.set_xticks(np.arange(len(evaluations)), [one.name for one in evaluations])
    axes.set_ylabel("held-out mean absolute error [mm]")
    how = f"{options.folds}-fold cross-validation, 95 % intervals" if options.folds else "one split"
    axes.set_title(f"Models on images they were not fitted to ({how})", fontsize=10)
    figure.legend(loc="outside lower center", fontsize=8, ncols=len(columns))
    axes.grid(axis="y", alpha=0.25)
    axes.set_axisbelow(True)
    axes.set_xlim(-0.6, len(evaluations) - 0.4)
    return figure
