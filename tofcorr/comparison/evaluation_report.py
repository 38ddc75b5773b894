"""Files an evaluation: tables, all numbers as JSON, a chart, and TensorBoard."""

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from tofcorr.comparison.evaluation import METRICS, Metric, Protocol, Scores, SetEvaluation, pairs
from tofcorr.comparison.evaluation_options import EvaluationOptions
from tofcorr.comparison.figures import comparison_figure
from tofcorr.comparison.monitor import write_comparison
from tofcorr.comparison.statistics import Estimate
from tofcorr.comparison.tables import tables
from tofcorr.options import dump_yaml
from tofcorr.training.figures import save_figure
from tofcorr.version import __version__


def write_evaluation(
    folder: Path, evaluations: Sequence[SetEvaluation], options: EvaluationOptions
) -> str:
    """Write `evaluation.json`, `evaluation.md`, `comparison.png`, `config.yaml` and `tb/`.

    Args:
        folder: An existing folder, usually a staged one.
        evaluations: One a set, in the order of the tables' rows.
        options: What was asked for.

    Returns:
        The tables as text for a terminal.
    """
    found = tables(evaluations, options)
    warnings = [f"{one.name}: {text}" for one in evaluations for text in one.warnings]
    mapping = evaluation_mapping(evaluations, options)
    (folder / "evaluation.json").write_text(
        json.dumps(mapping, indent=1, allow_nan=False) + "\n", encoding="utf-8"
    )
    page = ["# Evaluation", *(table.markdown() for table in found)]
    page += ["Warnings:", "\n".join(f"- {text}" for text in warnings)] if warnings else []
    (folder / "evaluation.md").write_text("\n\n".join(page) + "\n", encoding="utf-8")
    (folder / "config.yaml").write_text(dump_yaml(options.to_mapping()), encoding="utf-8")
    figure = comparison_figure(evaluations, options)
    save_figure(figure, folder / "comparison.png")
    write_comparison(folder / "tb", figure, [table.markdown() for table in found])
    parts = [table.text() for table in found] + [f"Warning: {text}" for text in warnings]
    return "\n\n".join(parts)


def evaluation_mapping(
    evaluations: Sequence[SetEvaluation], options: EvaluationOptions
) -> dict[str, Any]:
    """Return every number of an evaluation as plain values, unknown ones as None."""
    return {
        "format": "tofcorr-evaluation",
        "version": 1,
        "tofcorr": __version__,
        "columns": options.columns,
        "seed": options.seed,
        "outlier_window_mm": options.outlier_window_mm,
        "sets": [_set_mapping(one, options) for one in evaluations],
    }


def _set_mapping(one: SetEvaluation, options: EvaluationOptions) -> dict[str, Any]:
    return {
        "name": one.name,
        "frames": one.num_frames,
        "targets": one.targets,
        "pixels": one.num_pixels,
        "hand_eye_estimated": one.hand_eye_estimated,
        "hand_eye": {name: transform.tolist() for name, transform in one.hand_eye.items()},
        "held_out": {
            protocol: _protocol_mapping(one, protocol, scores, options)
            for protocol, scores in one.scores.items()
        },
        "warnings": one.warnings,
    }


def _protocol_mapping(
    one: SetEvaluation, protocol: Protocol, scores: Scores, options: EvaluationOptions
) -> dict[str, Any]:
    errors = {
        metric: {
            column: _estimate_mapping(one.estimate(protocol, metric, column))
            | {"splits": [_or_none(value) for value in scores.values[metric][column].tolist()]}
            for column in options.columns
        }
        for metric in METRICS
    }
    tests = [
        _test_mapping(one, protocol, metric, first, second)
        for metric in METRICS
        for first, second in pairs(options.columns)
        if len(scores.splits) > 1
    ]
    return {
        "test_frames": [split.test.tolist() for split in scores.splits],
        "error_mm": errors,
        "paired_tests": tests,
    }


def _test_mapping(
    one: SetEvaluation, protocol: Protocol, metric: Metric, first: str, second: str
) -> dict[str, Any]:
    found = one.difference(protocol, metric, first, second)
    return {
        "metric": metric,
        "first": first,
        "second": second,
        "first_minus_second_mm": _estimate_mapping(found),
        "p_value": _or_none(found.p_value),
        "degrees_of_freedom": found.degrees_of_freedom,
        "significant": found.significant,
    }


def _estimate_mapping(estimate: Estimate) -> dict[str, Any]:
    return {
        "mean": _or_none(estimate.mean),
        "ci": [
            _or_none(estimate.mean - estimate.half_width),
            _or_none(estimate.mean + estimate.half_width),
        ],
        "standard_deviation": _or_none(estimate.standard_deviation),
    }


def _or_none(value: float) -> float | None:
    """JSON has no NaN: what is not known is null."""
    return value if math.isfinite(value) else None
