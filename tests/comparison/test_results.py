"""`tofcorr.evaluate` and `tofcorr.select`: what the commands print, draw and write, as results."""

import json
from pathlib import Path

import pytest
from click.testing import CliRunner
from simulated_walls import EA, simulated_wall

import tofcorr
from tofcorr.cli.main import group as cli
from tofcorr.data.recording import Recording
from tofcorr.options import dump_yaml

MODELS = [{"name": "constant"}, {"name": "EA", "model": EA.to_mapping()}]
EVALUATE = {"models": MODELS, "folds": 3}
SELECT = {"models": MODELS, "by": ["image", "target"], "folds": 3}


@pytest.fixture(scope="module")
def wall(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    return simulated_wall(tmp_path_factory.mktemp("wall") / "wall").first


@pytest.fixture(scope="module")
def evaluation(wall: Recording) -> tofcorr.EvaluationResult:
    return tofcorr.evaluate(wall, EVALUATE)


@pytest.fixture(scope="module")
def selection(wall: Recording) -> tofcorr.SelectionResult:
    return tofcorr.select([wall.path], SELECT)


def fail(constant: str) -> None:
    pytest.fail(f"{constant} is no number of JSON")


def run(command: str, config: dict, recording: Path, folder: Path) -> str:
    (folder / "config.yaml").write_text(dump_yaml(config))
    given = ["--config", folder / "config.yaml", "--recording", recording, "--out", folder / "out"]
    return CliRunner().invoke(cli, [command, *map(str, given)], catch_exceptions=False).stdout


def test_evaluate_returns_what_the_command_prints_and_writes(
    wall: Recording, evaluation: tofcorr.EvaluationResult, tmp_path: Path
) -> None:
    printed = run("evaluate", EVALUATE, wall.path, tmp_path)
    assert repr(evaluation) in printed
    written = json.loads((tmp_path / "out" / "evaluation.json").read_text(), parse_constant=fail)
    assert written == json.loads(json.dumps(evaluation.to_mapping()))
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert names == {"evaluation.json", "evaluation.md", "comparison.png", "config.yaml", "tb"}
    assert "Table 2" in printed
    half, folds = (written["sets"][0]["held_out"][name] for name in ("half", "folds"))
    assert len(folds["error_mm"]["rms_mm"]["EA"]["splits"]) == 3
    assert {test["degrees_of_freedom"] for test in folds["paired_tests"]} == {2}
    assert half["error_mm"]["rms_mm"]["EA"]["ci"] == [None, None]


def test_select_returns_what_the_command_prints_and_writes(
    wall: Recording, selection: tofcorr.SelectionResult, tmp_path: Path
) -> None:
    printed = run("select", SELECT, wall.path, tmp_path)
    assert repr(selection) in printed
    written = json.loads((tmp_path / "out" / "selection.json").read_text(), parse_constant=fail)
    assert written == json.loads(json.dumps(selection.to_mapping()))
    assert (tmp_path / "out" / "selection.md").read_text() == selection.markdown()
    assert "| EA |" in selection.markdown()
    assert selection.winner == "EA"
    assert selection.ties == []


def test_results_are_drawn(evaluation: tofcorr.EvaluationResult) -> None:
    (comparison,) = evaluation.plot_comparison().axes
    assert [text.get_text() for text in comparison.get_xticklabels()] == ["wall"]


def test_every_set_is_a_row_and_recordings_of_one_selection_are_taken_together(
    wall: Recording, evaluation: tofcorr.EvaluationResult
) -> None:
    twice = tofcorr.evaluate([wall, wall.path], EVALUATE)
    assert [one.name for one in twice.sets] == ["wall (1)", "wall (2)"]
    assert twice.sets[0].targets == evaluation.sets[0].targets
    values = twice.sets[1].values["half"]["rms_mm"]["EA"]
    assert values == evaluation.sets[0].values["half"]["rms_mm"]["EA"]
