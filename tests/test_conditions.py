"""Every condition reaches every place that carries conditions, under its own name and unit."""

import inspect
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
import torch
from small_recordings import frame_rows, write_small_recording

from tofcorr.conditions import CONDITIONS, OPTIONAL_CONDITIONS, Condition, condition
from tofcorr.correction.corrector import DepthCorrector
from tofcorr.data.recording import Recording, frame_conditions
from tofcorr.data.table import FrameRow, FrameTable
from tofcorr.error_terms.condition_terms import in_si_units, with_means
from tofcorr.errors import CalibrationDataError
from tofcorr.simulation.hooks import FrameFacts

OPTIONAL = pytest.mark.parametrize("known", OPTIONAL_CONDITIONS, ids=lambda each: each.name)


@pytest.mark.parametrize("holder", [FrameRow, FrameTable, FrameFacts])
def test_whatever_holds_conditions_holds_all_of_them(holder: type) -> None:
    assert {field.name for field in fields(holder)} >= set(CONDITIONS)


def test_names_and_columns_of_the_format_stay() -> None:
    assert CONDITIONS[:5] == (
        "timestamp",
        "integration_time",
        "room_temperature",
        "body_temperature",
        "ambient",
    )
    columns = [each.column for each in OPTIONAL_CONDITIONS]
    agreed = ["integration_time_us", "body_temperature_c", "room_temperature_c", "ambient"]
    assert columns[:4] == agreed
    assert condition("timestamp").column == "timestamp_s"


@OPTIONAL
def test_a_condition_survives_the_file_and_reaches_the_conditions_tensor(
    known: Condition, tmp_path: Path
) -> None:
    rows = frame_rows(np.random.default_rng(0))
    for frame, row in enumerate(rows):
        object.__setattr__(row, known.name, (400.0 + frame) * known.si_per_unit)
    recording = Recording.open(write_small_recording(tmp_path / "recording", rows=rows))
    header, first = (recording.path / "frames.csv").read_text().splitlines()[:2]
    assert first.split(",")[header.split(",").index(known.column)] in ("400", "400.0")
    expected = (400.0 + torch.arange(len(rows), dtype=torch.float64)) * known.si_per_unit
    tensor = frame_conditions(recording.frames)[:, CONDITIONS.index(known.name)]
    torch.testing.assert_close(tensor, expected)


@OPTIONAL
def test_what_needs_a_condition_names_its_column(known: Condition, tmp_path: Path) -> None:
    rows = frame_rows(np.random.default_rng(0))
    for row in rows:
        object.__setattr__(row, known.name, None)
    recording = Recording.open(write_small_recording(tmp_path / "recording", rows=rows))
    with pytest.raises(CalibrationDataError, match=f"column '{known.column}' is missing"):
        recording.require(known.name, "the test")


def test_the_corrector_takes_the_conditions_by_their_columns() -> None:
    """TorchScript needs the names written out in `set_conditions`; here they are held together."""
    keywords = list(inspect.signature(DepthCorrector.set_conditions).parameters)[1:]
    assert keywords == [condition(name).column for name in CONDITIONS]


@pytest.mark.parametrize("name", CONDITIONS)
def test_a_keyword_in_its_unit_becomes_the_condition_in_its_place(name: str) -> None:
    each = condition(name)
    given = {each.column: torch.tensor([2.0, torch.nan])}
    known = in_si_units(given, (2,), torch.float64, torch.device("cpu"))
    mean = torch.arange(float(len(CONDITIONS)), dtype=torch.float64)
    expected = mean.repeat(2, 1)
    expected[0, CONDITIONS.index(name)] = 2.0 * each.si_per_unit
    torch.testing.assert_close(with_means(known, mean), expected, rtol=1e-15, atol=0.0)
