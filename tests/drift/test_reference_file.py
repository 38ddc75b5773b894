"""The reference of a calibration survives its file, and a damaged file is refused."""

import hashlib
import json
from pathlib import Path
from typing import Any

import pytest
from optional import present

from tofcorr.correction.state import CalibrationState
from tofcorr.errors import CalibrationDataError
from tofcorr.fit.reference import REFERENCE_FILE, Reference, load_reference, save_reference


@pytest.fixture
def path(state: CalibrationState, reference: Reference, tmp_path: Path) -> Path:
    save_reference(tmp_path / REFERENCE_FILE, reference, state)
    return tmp_path / REFERENCE_FILE


def rewrite(path: Path, removed: tuple[str, ...] = (), **changes: Any) -> None:
    """Change a file's values, and seal it again."""
    values = json.loads(path.read_text()) | changes
    kept = {key: one for key, one in values.items() if key not in ("sha256", *removed)}
    digest = hashlib.sha256(json.dumps(kept, sort_keys=True).encode()).hexdigest()
    path.write_text(json.dumps(kept | {"sha256": digest}))


def test_the_reference_comes_back_from_its_file(
    state: CalibrationState, reference: Reference, path: Path
) -> None:
    back = present(load_reference(path, state))
    assert back.to_mapping() == reference.to_mapping()
    # One of an older version has neither scatter nor what came with it.
    rewrite(path, removed=("scatter", "covariance_within", "views"))
    back = present(load_reference(path, state))
    assert (back.scatter, back.covariance_within, back.views) == (1.0, None, None)


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("coefficients", None, "of another calibration"),
        ("mean", "text", "'mean'"),
        ("persistence", 1.0, "'persistence': .*less than 1"),
        ("poses", 1.5, "'poses': .*integer"),
        ("scatter", 0.0, "'scatter': .*greater than 0"),
        ("noise", [1.0, float("nan"), 0.0], "'noise.1': .*finite"),
        ("version", 1, "version"),
    ],
)
def test_a_damaged_reference_is_refused(
    state: CalibrationState, path: Path, key: str, value: Any, words: str
) -> None:
    rewrite(path, **{key: value})
    with pytest.raises(CalibrationDataError, match=words):
        load_reference(path, state)


def test_a_reference_with_a_changed_digit_or_of_another_calibration_is_refused(
    state: CalibrationState, path: Path
) -> None:
    other = state.model_copy(update={"coefficients": state.coefficients + 1e-6})
    with pytest.raises(CalibrationDataError, match="of another calibration"):
        load_reference(path, other)
    path.write_text(path.read_text().replace('"poses": 30', '"poses": 31'))
    with pytest.raises(CalibrationDataError, match="changed after it was written"):
        load_reference(path, state)
    path.write_text("[1, 2")
    with pytest.raises(CalibrationDataError, match="cannot be read"):
        load_reference(path, state)
