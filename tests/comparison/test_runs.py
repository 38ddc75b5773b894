"""`tofcorr.compare`: runs of one camera side by side."""

import json
import shutil
from pathlib import Path

import pytest
from running import Program
from simulated_walls import CAMERA, EA, simulated_wall

import tofcorr


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("runs")
    wall = simulated_wall(folder / "wall").first.path
    models = {"ea": EA.to_mapping(), "constant": {}}
    for name, model in models.items():
        tofcorr.train(wall, {"name": name, "model": model, "figures": False}, out=folder / name)
    return [folder / name for name in models]


def moved(run: Path, folder: Path, millimetres: float) -> Path:
    """Return a copy of a run whose report has the camera elsewhere."""
    shutil.copytree(run, folder)
    report = json.loads((folder / "report.json").read_text())
    report["hand_eye"]["tool_from_camera"][0][3] += millimetres / 1e3
    (folder / "report.json").write_text(json.dumps(report))
    return folder


def test_a_run_does_not_differ_from_itself(runs: list[Path]) -> None:
    found = tofcorr.compare([runs[0], runs[0]])
    (difference,) = found.hand_eyes
    assert difference.p_value == pytest.approx(1)
    assert difference.shift_mm == 0
    assert found.differing == []


def test_hand_eyes_differ_where_the_shift_exceeds_their_errors(
    runs: list[Path], tmp_path: Path
) -> None:
    report = json.loads((runs[0] / "report.json").read_text())
    half_width = report["hand_eye"]["translation_ci95_mm"][0]
    far = moved(runs[0], tmp_path / "far", 6 * half_width)
    near = moved(runs[0], tmp_path / "near", half_width / 6)
    (first, second, _) = tofcorr.compare([runs[0], far, near]).hand_eyes
    assert first.significant
    assert first.shift_mm == pytest.approx(6 * half_width)
    assert not second.significant


def test_the_command_prints_a_short_table_and_writes_a_page(
    runs: list[Path], tmp_path: Path, program: Program
) -> None:
    page = tmp_path / "page.html"
    code, printed, _ = program("compare", *runs, "--out", page)
    found = tofcorr.compare(runs)
    assert (code, printed) == (0, f"{found!r}\nWritten to {page}\n")
    assert len(printed.splitlines()) <= 12
    assert found.verdict.startswith("ea has the smallest held-out error")
    assert "model.terms.0.kind" in [row[0] for row in found.differing]
    assert found.verdict in page.read_text()
    assert set(map(str, found.hand_eyes)) <= set(found.details.splitlines())


def test_runs_of_other_recordings_are_named_and_of_other_cameras_refused(
    runs: list[Path], tmp_path: Path
) -> None:
    other = moved(runs[0], tmp_path / "other", 0)
    report = json.loads((other / "report.json").read_text()) | {"recordings": ["elsewhere"]}
    (other / "report.json").write_text(json.dumps(report))
    assert "different recordings" in tofcorr.compare([runs[0], other]).notes[0]
    wide = simulated_wall(
        tmp_path / "wide", camera=CAMERA | {"distortion": [0.01, 0.0, 0.0, 0.0, 0.0]}
    ).first.path
    tofcorr.train(wide, {"name": "bent", "model": {}, "figures": False}, out=tmp_path / "run")
    with pytest.raises(tofcorr.CalibrationDataError, match="the cameras or their lenses differ"):
        tofcorr.compare([runs[0], tmp_path / "run"])
    with pytest.raises(tofcorr.CalibrationDataError, match="give two runs at least"):
        tofcorr.compare(runs[:1])
