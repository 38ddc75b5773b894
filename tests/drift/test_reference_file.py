"""The reference of a calibration survives its file, and a damaged file is refused."""

import hashlib
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from tofcorr.correction.state import CalibrationState
from tofcorr.errors import CalibrationDataError
from tofcorr.fit.reference import REFERENCE_FILE, Reference, load_reference, save_reference


def test_the_reference_comes_back_from_its_file(
    state: CalibrationState, reference: Reference, tmp_path: Path
) -> None:
    path = tmp_path / REFERENCE_FILE
    save_reference(path, reference, state)
    back = load_reference(path, state)
    assert back is not None
    assert torch.equal(back.covariance, reference.covariance)
    assert torch.equal(back.mean, reference.mean)
    assert back.covariance_within is not None
    assert reference.covariance_within is not None
    assert torch.equal(back.covariance_within, reference.covariance_within)
    assert (back.poses, back.noise) == (reference.poses, reference.noise)
    assert back.scatter == reference.scatter
    assert back.views is not None
    assert reference.views is not None
    assert torch.equal(back.views, reference.views)


def test_a_reference_of_an_older_version_has_neither_scatter_nor_what_came_with_it(
    state: CalibrationState, reference: Reference, tmp_path: Path
) -> None:
    path = tmp_path / REFERENCE_FILE
    save_reference(path, reference, state)
    values = json.loads(path.read_text())
    for key in ("scatter", "covariance_within", "views", "sha256"):
        del values[key]
    digest = hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()
    path.write_text(json.dumps(values | {"sha256": digest}))
    back = load_reference(path, state)
    assert back is not None
    assert (back.scatter, back.covariance_within, back.views) == (1.0, None, None)


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("covariance", [[1.0]], "covariance: has shape"),
        ("covariance_within", [[1.0]], "covariance_within: has shape"),
        ("coefficients", None, "is damaged"),
        ("mean", "text", "is damaged"),
        ("random_variance", [1.0, -1.0] + [1.0] * 13, "random_variance: expected positive"),
        ("persistence", 1.0, "persistence: expected a number from 0 to below 1"),
        ("poses", 1.5, "poses: expected a positive whole number"),
        ("scatter", 0.0, "scatter: expected positive"),
        ("views", [[1.0, 2.0]], "views: has shape"),
        ("noise", [1.0, float("nan"), 0.0], "not finite"),
        ("version", 1, "version"),
    ],
)
def test_a_damaged_reference_is_refused(
    state: CalibrationState,
    reference: Reference,
    key: str,
    value: Any,
    words: str,
    tmp_path: Path,
) -> None:
    path = tmp_path / REFERENCE_FILE
    save_reference(path, reference, state)
    values = json.loads(path.read_text()) | {key: value}
    del values["sha256"]
    digest = hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()
    path.write_text(json.dumps(values | {"sha256": digest}))
    with pytest.raises(CalibrationDataError, match=words):
        load_reference(path, state)


def test_a_changed_digit_of_the_reference_is_noticed(
    state: CalibrationState, reference: Reference, tmp_path: Path
) -> None:
    path = tmp_path / REFERENCE_FILE
    save_reference(path, replace(reference, poses=30), state)
    path.write_text(path.read_text().replace('"poses": 30', '"poses": 31'))
    with pytest.raises(CalibrationDataError, match="changed after it was written"):
        load_reference(path, state)


def test_the_reference_of_another_calibration_is_refused(
    state: CalibrationState, reference: Reference, tmp_path: Path
) -> None:
    path = tmp_path / REFERENCE_FILE
    save_reference(path, reference, state)
    other = state.model_copy(update={"coefficients": state.coefficients + 1e-6})
    with pytest.raises(CalibrationDataError, match="of another calibration"):
        load_reference(path, other)
