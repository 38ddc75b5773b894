"""What an evaluation prints and writes, and what it refuses."""

from typing import Any

import pytest
from comparison.evaluated import MODELS, options

from tofcorr.comparison.evaluate import (
    EvaluationResult,
    main_pairs,
    pairs,
)
from tofcorr.comparison.experiment import Experiment
from tofcorr.comparison.options import BEFORE, HAND_EYE_ONLY
from tofcorr.errors import ConfigError


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"models": []}, "models"),
        ({"models": [MODELS[0], MODELS[0]]}, "two columns would be called 'E0'"),
        ({"models": [{"name": "before"}]}, "two columns would be called 'before'"),
        ({"folds": 1}, "one fold leaves nothing"),
        ({"fold": 6}, "Did you mean 'folds'"),
        ({"outlier_window_mm": -1.0}, "outlier_window_mm"),
        ({"models": [{"name": "a", "split": {"seed": 1}}]}, "'split' cannot differ from model"),
        ({"models": [{"name": "a", "device": "cuda"}]}, "'device' cannot differ from model"),
        ({"models": [{"config": "ea_rubost"}]}, "Did you mean 'ea_robust'"),
        ({"models": [{"config": 3}]}, "'config' is the name or the file of a training"),
        ({"models": [{"name": "a", "weight": {}}]}, "Did you mean 'weights'"),
    ],
)
def test_options_that_make_no_sense_are_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        options(**changes)


def test_pairs_leave_before_out_and_the_main_ones_are_a_chain_and_a_star() -> None:
    columns = [BEFORE, HAND_EYE_ONLY, "a", "b", "c"]
    assert len(pairs(columns)) == 6
    assert main_pairs(columns) == [
        (HAND_EYE_ONLY, "a"), ("a", "b"), ("a", "c"), ("b", "c"),
    ]  # fmt: skip


def test_tables_have_the_papers_layout(evaluation: Experiment) -> None:
    asked = options(repeats={"number": 3, "test_fraction": 0.25})
    half, folds, *_ = EvaluationResult([evaluation, evaluation], asked).tables()
    for table in (half, folds):
        assert table.header == ["set", BEFORE, HAND_EYE_ONLY, "E0", "EA", "EB"]
        assert len(table.rows) == 2
    assert half.rows[0][0] == "wall (16 checkerboard, 16 white)"
    estimate = evaluation.estimate("folds", "mean_abs_mm", "EA")
    assert folds.rows[0][4] == f"{estimate.mean:.2f} ± {estimate.half_width:.2f}"
    lines = half.text().splitlines()
    assert len({line.index("before") + 6 for line in lines if "before" in line}) == 1
    assert len({len(line) for line in lines[2:6]}) == 1
