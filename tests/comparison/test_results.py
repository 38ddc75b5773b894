"""`tofcorr.evaluate` and `tofcorr.select`: what the commands print, draw and write, as results."""

import html
import json
from collections.abc import Callable
from itertools import chain
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner
from shown_pages import fetched, silent
from simulated_walls import EA, simulated_wall

import tofcorr
from tofcorr.cli.main import group as cli
from tofcorr.comparison.experiment import ModelFitter
from tofcorr.comparison.options import ComparedModel
from tofcorr.data.recording import Recording
from tofcorr.options import dump_yaml
from tofcorr.pixels.passes import FittedModel

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
    files = {"evaluation.json", "evaluation.md", "comparison.png", "config.yaml", "tb"}
    assert names == files | {"report.html"}
    assert "Table 2" in evaluation.details
    assert len(printed.splitlines()) <= 12
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
    assert comparison.get_title("left") == "wall"
    labels = [text.get_text() for text in comparison.get_yticklabels()]
    printed = [line.split("  ")[0] for line in repr(evaluation).splitlines()]
    assert sorted(labels) == sorted(evaluation.options.columns)
    assert [name for name in printed if name in labels] == labels


def test_pages_hold_the_verdict_and_every_cell_of_the_tables(
    evaluation: tofcorr.EvaluationResult, selection: tofcorr.SelectionResult
) -> None:
    own, verdict = evaluation.to_mapping()["sets"][0]["held_out"]["folds"], selection.verdict
    best = own["error_mm"]["mean_abs_mm"]["EA"]["mean"]
    first = f"wall: EA has the smallest held-out error, {best:.2f} mm"
    for result, said in ((evaluation, first), (selection, verdict)):
        page = result.page()
        assert (fetched(page), silent(page)) == ([], 0)
        shown = html.unescape(page)
        assert said in shown[: shown.index("<h2>")]
        for table in result.tables():
            for cell in chain((table.title, table.note), table.header, *table.rows):
                assert f">{cell}<" in shown


def test_every_set_is_a_row_and_recordings_of_one_selection_are_taken_together(
    wall: Recording, evaluation: tofcorr.EvaluationResult
) -> None:
    twice = tofcorr.evaluate([wall, wall.path], EVALUATE)
    assert [one.name for one in twice.sets] == ["wall (1)", "wall (2)"]
    assert twice.sets[0].targets == evaluation.sets[0].targets
    values = twice.sets[1].values["half"]["rms_mm"]["EA"]
    assert values == evaluation.sets[0].values["half"]["rms_mm"]["EA"]


@pytest.mark.parametrize(
    ("command", "config"), [(tofcorr.evaluate, EVALUATE), (tofcorr.select, SELECT)]
)
def test_what_is_finished_when_stopped_is_filed_and_nothing_else(
    command: Callable[..., Any],
    config: dict[str, Any],
    wall: Recording,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Ctrl-C in the fifth minute of six left nothing."""
    fit, stopped, told = ModelFitter.fit, ["EA"], list[str]()

    def interrupted(self: ModelFitter, model: ComparedModel, *frames: Any) -> FittedModel:
        if model.name in stopped:
            raise KeyboardInterrupt
        return fit(self, model, *frames)

    monkeypatch.setattr(ModelFitter, "fit", interrupted)
    result = command(wall, config, out=tmp_path / "out", tell=told.append)
    assert "Stopped: EA not finished, and left out" in repr(result)
    (written,) = (tmp_path / "out").glob("*on.json")
    assert '"EA"' not in written.read_text()
    assert '"constant"' in written.read_text()
    assert f"{len(config['models'])} models" in told[0]
    assert [line.split(":")[0] for line in told if "RMS held out" in line][-1] == "constant"
    assert any(line.startswith("The other models will take about") for line in told)
    stopped.append("constant")
    with pytest.raises(KeyboardInterrupt):
        command(wall, config, out=tmp_path / "nothing", tell=told.append)
    assert [path.name for path in tmp_path.iterdir()] == ["out"]
