"""The page of named numbers is what the source says, and the source says enough."""

from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner
from docs.pages import ROOT

from scripts import thresholds_page


@pytest.fixture(scope="module")
def numbers() -> list[Any]:
    return thresholds_page.all_named_numbers()


def test_page_is_what_the_script_writes(numbers: list[Any]) -> None:
    kept = (ROOT / "docs" / "thresholds.md").read_text(encoding="utf-8")
    assert kept == thresholds_page.page(numbers), "run: python scripts/thresholds_page.py"


def test_every_named_number_says_what_it_does_and_why(numbers: list[Any]) -> None:
    assert len(numbers) > 200
    silent = [(one.module, one.names) for one in numbers if not (one.comment and one.origin)]
    assert silent == []


def test_units_and_reasons_are_read_from_comments() -> None:
    number = thresholds_page.NamedNumber(
        module="a.py",
        names=("_FAR",),
        values=("2.0",),
        comment="Walls farther than this, metres, are not used. Chosen.",
    )
    assert number.units == "m"
    assert number.purpose == "Walls farther than this, metres, are not used."
    assert number.origin == "Chosen."


def test_asking_for_help_writes_no_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(thresholds_page, "PAGE", tmp_path / "page.md")
    run = CliRunner().invoke
    assert "Write docs/thresholds.md" in run(thresholds_page.main, ["--help"]).output
    assert not thresholds_page.PAGE.exists()
    assert run(thresholds_page.main, []).exit_code == 0
    assert thresholds_page.PAGE.exists()
