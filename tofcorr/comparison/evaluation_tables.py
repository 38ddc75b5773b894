"""The tables of an evaluation."""

import math
from collections.abc import Sequence

from tofcorr.comparison.evaluation import Metric, SetEvaluation, main_pairs
from tofcorr.comparison.evaluation_options import HAND_EYE_ONLY, EvaluationOptions
from tofcorr.comparison.split_statistics import Estimate
from tofcorr.comparison.splits import Protocol
from tofcorr.comparison.table import Table


def tables(evaluations: Sequence[SetEvaluation], options: EvaluationOptions) -> list[Table]:
    """Return the tables of the protocols that the options ask for."""
    found = [_half_table(evaluations, options)]
    if options.folds:
        found.append(_folds_table(evaluations, options))
        found.append(_tests_table(evaluations, options, "folds", "mean_abs_mm"))
    if options.repeats.number:
        found.append(_repeats_table(evaluations, options, "rms_mm"))
        found.append(_repeats_table(evaluations, options, "rms_z_mm"))
        found.append(_tests_table(evaluations, options, "repeats", "rms_mm"))
    return found


def _half_table(evaluations: Sequence[SetEvaluation], options: EvaluationOptions) -> Table:
    rows = []
    for one in evaluations:
        values = one.scores["half"].values
        cells = [
            f"{values['mean_abs_mm'][column][0]:.2f} ({values['rms_mm'][column][0]:.2f})"
            for column in options.columns
        ]
        rows.append([f"{one.name} ({_images(one)})", *cells])
    held_out = f"{100 * options.test_fraction:.0f} %"
    return Table(
        f"Table 1. Mean absolute error per pixel (RMS), mm, on {held_out} of the poses held out",
        ["set", *options.columns],
        rows,
        f"One random split a set, seed {options.seed}. {_GEOMETRY}",
    )


def _folds_table(evaluations: Sequence[SetEvaluation], options: EvaluationOptions) -> Table:
    rows = [
        [one.name, *(_interval(one.estimate("folds", "mean_abs_mm", c)) for c in options.columns)]
        for one in evaluations
    ]
    factor = _t_factor(evaluations[0].estimate("folds", "mean_abs_mm", HAND_EYE_ONLY))
    return Table(
        f"Table 2. Mean absolute error per pixel, mm, {options.folds}-fold cross-validation",
        ["set", *options.columns],
        rows,
        f"Mean over the folds ± {factor:.2f} SE (95 %, Student's t). Images of one pose stay "
        f"together. Seed {options.seed}.",
    )


def _repeats_table(
    evaluations: Sequence[SetEvaluation], options: EvaluationOptions, metric: Metric
) -> Table:
    rows = []
    for one in evaluations:
        found = [one.estimate("repeats", metric, column) for column in options.columns]
        rows.append([one.name, *(f"{e.mean:.2f} ± {e.standard_deviation:.2f}" for e in found)])
        low_high = [f"{e.mean - e.half_width:.2f}–{e.mean + e.half_width:.2f}" for e in found]
        rows.append(["  95 % interval", *low_high])
    kind = {"rms_mm": "distance to the plane", "rms_z_mm": "error of the z depth"}
    held_out = f"{100 * options.repeats.test_fraction:.0f} %"
    return Table(
        f"Held-out RMS {kind.get(metric, metric)}, mm, {options.repeats.number} random splits "
        f"by pose, {held_out} held out",
        ["set", *options.columns],
        rows,
        "Mean ± standard deviation over the splits; the interval allows for their overlap "
        f"(Nadeau and Bengio 2003). Seed {options.seed}.",
    )


def _tests_table(
    evaluations: Sequence[SetEvaluation],
    options: EvaluationOptions,
    protocol: Protocol,
    metric: Metric,
) -> Table:
    rows = []
    dof = 0
    for one in evaluations:
        for first, second in main_pairs(options.columns):
            found = one.difference(protocol, metric, first, second)
            dof = found.degrees_of_freedom
            before = one.estimate(protocol, metric, first).mean
            share = f"{100 * abs(found.mean) / before:.0f} %"
            better = second if found.mean > 0 else first
            verdict = f"{better} better by {share}" if found.significant else "no difference found"
            rows.append(
                [f"{one.name}: {first} / {second}", _interval(found), _p(found.p_value), verdict]
            )
    name = "mean absolute error" if metric == "mean_abs_mm" else "RMS"
    source = "folds" if protocol == "folds" else "random splits, corrected for their overlap"
    return Table(
        f"Paired t-tests of held-out {name} on the {source}",
        ["set: first / second", "first − second, mm", "p", "verdict"],
        rows,
        f"± 95 %, Student's t with {dof} degrees of freedom, two-sided, each test by itself; "
        "all pairs are in evaluation.json.",
    )


_GEOMETRY = "'hand-eye only': hand-eye refitted, no depth correction."


def _images(one: SetEvaluation) -> str:
    return ", ".join(f"{count} {target}" for target, count in one.targets.items())


def _interval(estimate: Estimate) -> str:
    return f"{estimate.mean:.2f} ± {estimate.half_width:.2f}"


def _p(value: float) -> str:
    return "<0.0001" if value < 1e-4 else f"{value:.4f}"


def _t_factor(estimate: Estimate) -> float:
    error = estimate.standard_deviation / math.sqrt(estimate.degrees_of_freedom + 1)
    return estimate.half_width / error if error else math.nan
