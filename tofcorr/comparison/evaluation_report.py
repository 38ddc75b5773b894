"""The report of an evaluation: tables, all numbers as JSON, a chart, and TensorBoard."""

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from tofcorr.comparison.comparability import comparability_notes
from tofcorr.comparison.comparison_options import masks_of
from tofcorr.comparison.evaluation import METRICS, Metric, Scores, SetEvaluation, pairs
from tofcorr.comparison.evaluation_figure import comparison_figure
from tofcorr.comparison.evaluation_options import EvaluationOptions
from tofcorr.comparison.evaluation_tables import tables
from tofcorr.comparison.monitor import write_comparison
from tofcorr.comparison.split_statistics import Estimate
from tofcorr.comparison.splits import Protocol
from tofcorr.options import dump_yaml
from tofcorr.training.figures import save_figure
from tofcorr.version import __version__


def write_evaluation(
    folder: Path,
    evaluations: Sequence[SetEvaluation],
    options: EvaluationOptions,
    headlines: Sequence[str] = (),
) -> None:
    """Write `evaluation.json`, `evaluation.md`, `comparison.png`, `config.yaml` and `tb/`.

    Args:
        folder: An existing folder, usually a staged one.
        evaluations: One a set, in the order of the tables' rows.
        options: Models and protocols.
        headlines: What makes a recording doubtful.
    """
    mapping = evaluation_mapping(evaluations, options, headlines)
    (folder / "evaluation.json").write_text(
        json.dumps(mapping, indent=1, allow_nan=False) + "\n", encoding="utf-8"
    )
    page = evaluation_markdown(evaluations, options, headlines)
    (folder / "evaluation.md").write_text(page, encoding="utf-8")
    (folder / "config.yaml").write_text(dump_yaml(options.to_mapping()), encoding="utf-8")
    figure = comparison_figure(evaluations, options)
    image = save_figure(figure, folder / "comparison.png")
    in_markdown = [table.markdown() for table in tables(evaluations, options)]
    write_comparison(folder / "tb", image, in_markdown)


def evaluation_text(evaluations: Sequence[SetEvaluation], options: EvaluationOptions) -> str:
    """Return tables, notes and warnings as text for a terminal."""
    blocks = [table.text() for table in tables(evaluations, options)]
    blocks += [" ".join(notes)] if (notes := comparability_notes(options)) else []
    return "\n\n".join(blocks + [f"Warning: {text}" for text in _warnings(evaluations)])


def evaluation_markdown(
    evaluations: Sequence[SetEvaluation],
    options: EvaluationOptions,
    headlines: Sequence[str] = (),
) -> str:
    """Return tables, notes and warnings as a page of Markdown."""
    page = [
        "# Evaluation",
        *headlines,
        *(table.markdown() for table in tables(evaluations, options)),
    ]
    page += [" ".join(notes)] if (notes := comparability_notes(options)) else []
    warnings = _warnings(evaluations)
    page += ["Warnings:", "\n".join(f"- {text}" for text in warnings)] if warnings else []
    return "\n\n".join(page) + "\n"


def _warnings(evaluations: Sequence[SetEvaluation]) -> list[str]:
    return [f"{one.name}: {text}" for one in evaluations for text in one.warnings]


def evaluation_mapping(
    evaluations: Sequence[SetEvaluation],
    options: EvaluationOptions,
    headlines: Sequence[str] = (),
) -> dict[str, Any]:
    """Return every number of an evaluation as plain values, unknown ones as None."""
    return {
        "format": "tofcorr-evaluation",
        "version": 1,
        "tofcorr": __version__,
        "headlines": list(headlines),
        "columns": options.columns,
        "seed": options.seed,
        "outlier_window_mm": options.outlier_window_mm,
        "measured_on": masks_of(options).to_mapping() | {"planes": options.planes},
        "notes": comparability_notes(options),
        "sets": [_set_mapping(one, options) for one in evaluations],
    }


def _set_mapping(one: SetEvaluation, options: EvaluationOptions) -> dict[str, Any]:
    return {
        "name": one.name,
        "frames": one.num_frames,
        "targets": one.targets,
        "pixels": one.num_pixels,
        "left_out": one.left_out,
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
    """Return None for NaN, which JSON does not have."""
    return value if math.isfinite(value) else None
