"""`scripts/run.py` shows what the package is for, in eight lines."""

import json
import sys
from pathlib import Path

import pytest
from running import printed

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.slow
def test_the_job_ends_with_eight_lines_of_its_own_numbers(tmp_path: Path) -> None:
    out = tmp_path / "job"
    lines = printed(sys.executable, ROOT / "scripts" / "run.py", out, cwd=tmp_path).splitlines()
    *said, pages = lines[-9:]
    assert [line.split(".")[0] for line in said] == [str(number) for number in range(1, 9)]
    report = json.loads((out / "run" / "report.json").read_text())["error_mm"]
    before, after = (report[stage]["test"]["rms"] for stage in ("before", "after"))
    assert f"off by {before:.1f} mm" in said[0]
    assert after < before / 5
    assert f"as well: {after:.1f} mm" in said[1]
    diagnosis = json.loads((out / "diagnosis" / "diagnosis.json").read_text())
    # What the recording was made with, and its simulator lacks.
    assert diagnosis["effects"] == ["integration_time"]
    assert "integration_time is missing" in said[6]
    gap = diagnosis["gap_mm"]
    assert f"from {gap['before']:.1f} to {gap['after']:.1f} mm" in said[7]
    assert gap["after"] < gap["before"] / 3
    assert f"{out / 'diagnosis' / 'report.html'}" in pages
