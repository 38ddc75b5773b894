"""What a diagnosis writes."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from click.testing import CliRunner
from diagnosed_recordings import TIME, altered, recorded, simulator
from optional import present

from benchmarks.sealed.answers import contradictions
from tofcorr.cli.simulate import diagnose_command as command
from tofcorr.data.recording import Recording
from tofcorr.diagnosis.diagnose import diagnose
from tofcorr.diagnosis.options import DiagnosisOptions
from tofcorr.diagnosis.report.figures import FIGURES, all_figures
from tofcorr.diagnosis.report.result import DiagnosisResult, write_report
from tofcorr.diagnosis.report.words import table_of_stages
from tofcorr.observables.figures import drawings
from tofcorr.options import resolve_options
from tofcorr.simulation.options import SimulatorOptions
from tofcorr.simulation.simulator import simulate

KEYS_AGREED = {
    *("format", "version", "gap_mm", "parameter_gap_mm", "detected", "probability", "effects"),
    *("simulator", "stages", "attribution", "unknown_probability", "warnings"),
    *("cause_sets", "set_probabilities", "unknown", "ranking", "where", "transfer_mm"),
    *("hand_eye_shift_mm", "minimum_detectable_mm", "next_recording", "verdict"),
}


@pytest.fixture(scope="module")
def report(time_diagnosis: DiagnosisResult, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("report")
    write_report(time_diagnosis, folder)
    return folder


def test_the_report_folder_holds_page_findings_simulator_and_events(report: Path) -> None:
    names = {"diagnosis.json", "report.html", "sensor.yaml", "simulator_with_effects.yaml", "tb"}
    assert {path.name for path in report.iterdir()} == names


def test_the_findings_have_the_keys_agreed_and_name_the_cause(report: Path) -> None:
    found = json.loads((report / "diagnosis.json").read_text())
    assert found.keys() >= KEYS_AGREED
    assert found["effects"] == ["integration_time"]
    assert found["cause_sets"][0][0] == "integration_time"
    assert not contradictions(found)
    assert found["gap_mm"]["after"] < 0.5 * found["gap_mm"]["before"]
    assert found["where"][0]["covariate"] == "integration_time"
    names = {entry["effect"] for entry in found["ranking"]}
    assert names == set(found["minimum_detectable_mm"]) | {"motion", "timestamp_offset"}


@pytest.mark.parametrize(
    ("changed", "law"),
    [
        ({"detected": False}, "detected is named or unknown"),
        ({"set_probabilities": [0.4]}, "each set is more probable than not"),
        ({"cause_sets": [["lens", "integration_time"]]}, "each effect named leads its set"),
        ({"unknown_probability": 1.1}, "no effect is more probable than that any is there"),
        ({"verdict": "Nothing."}, "the verdict says what is named"),
    ],
)
def test_a_contradiction_is_seen(report: Path, changed: dict[str, object], law: str) -> None:
    found = json.loads((report / "diagnosis.json").read_text())
    assert law in contradictions(found | changed)


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_infinite_amplitudes_are_pixels_that_are_not_used(tmp_path: Path) -> None:
    """In every second pixel of all images: a traceback, since columns were not finite."""
    recording = recorded(tmp_path / "one", 33)
    second = np.arange(recording.depth.size).reshape(recording.depth.shape) % 2 == 0
    odd = altered(recording, lambda light: np.where(second, np.inf, light), "amplitude")
    diagnose(odd, config={"page": False, "bootstraps": 19}, out=tmp_path / "report")
    assert not contradictions(json.loads((tmp_path / "report" / "diagnosis.json").read_text()))


def test_the_page_needs_nothing_else(report: Path) -> None:
    page = (report / "report.html").read_text()
    assert not re.findall(r"<(?:script|link|iframe)\b", page)
    assert not re.findall(r'\b(?:src|href)="(?!#|data:)[^"]*', page)
    assert "integration_time" in page
    assert page.count("<svg") >= 7


def test_the_simulator_written_runs_and_repeats_the_effect(report: Path, tmp_path: Path) -> None:
    options = resolve_options(SimulatorOptions, report / "simulator_with_effects.yaml")
    assert [effect["name"] for effect in options.effects] == ["integration_time"]
    simulate(options, tmp_path / "again", num_frames=3)
    assert Recording.open(tmp_path / "again").num_frames == 3


def test_the_fitted_simulator_measures_what_is_predicted(time_diagnosis: DiagnosisResult) -> None:
    """Tables, hand-eye transform and effect pass through the whole simulator unharmed."""
    study, named = time_diagnosis.evidence.study, time_diagnosis.evidence.named
    twin = time_diagnosis.evidence.distance()
    fitted = study.observations.measured - named.study.residual_of(named.columns)
    # The fit is linear around the base fit; the simulator is not.
    assert float((twin - fitted).square().mean().sqrt()) < 2e-4


def test_the_gap_is_gone_in_the_simulator_with_the_effect(time_diagnosis: DiagnosisResult) -> None:
    closure = present(time_diagnosis.closure)
    assert closure.with_effects < 0.5 * closure.without_effects


@pytest.mark.slow
def test_a_simulator_that_has_the_effect_already_lacks_nothing(
    time_missing: Recording, time_diagnosis: DiagnosisResult
) -> None:
    complete = simulator(32, [TIME])
    found = diagnose(time_missing, complete, {"bootstraps": 19})
    assert found.effects == ()
    # What the true simulator leaves as given is what the robot does not repeat.
    assert present(found.gap.as_given) < 1.5e-3
    # Without a simulator there is nothing as given.
    assert time_diagnosis.gap.as_given is None


@pytest.mark.slow
def test_a_simulator_without_the_effect_gets_it(time_missing: Recording, tmp_path: Path) -> None:
    lacking = simulator(32)
    found = diagnose(time_missing, lacking, {"bootstraps": 19})
    assert found.effects == ("integration_time",)
    slope = present(found.simulator).effects[0]["log_1"]
    assert slope == pytest.approx(0.006, rel=0.2)


def test_the_result_prints_stages_verdict_and_warnings(time_diagnosis: DiagnosisResult) -> None:
    warned = replace(time_diagnosis, warnings=("The lens was dirty.",))
    causes = [f"- {cause}" for cause in time_diagnosis.causes]
    lines = [time_diagnosis.verdict, *table_of_stages(time_diagnosis), *causes]
    assert repr(time_diagnosis) == "\n".join(lines)
    assert repr(warned) == "\n".join([*lines, "Warning: The lens was dirty."])
    assert time_diagnosis.details == "\n".join([*lines, *time_diagnosis.remarks])


def test_every_figure_of_the_page_can_be_drawn_by_itself(time_diagnosis: DiagnosisResult) -> None:
    drawn = [time_diagnosis.plot(name) for name in FIGURES]
    others = drawings(time_diagnosis.observables)
    assert len(drawn) == len(all_figures(time_diagnosis)) - len(others) + 1 == 9
    assert all(figure.axes and any(axes.has_data() for axes in figure.axes) for figure in drawn)


def test_steps_of_the_gap_end_with_the_gap_that_remains(time_diagnosis: DiagnosisResult) -> None:
    assert time_diagnosis.gap_steps == (("integration_time", time_diagnosis.gap.after),)


def test_the_command_writes_the_report_and_finds_what_the_function_finds(
    time_missing: Recording, tmp_path: Path
) -> None:
    config = tmp_path / "quick.yaml"
    # Effects that are tested by poses, by tiles, and as maps.
    effects = "[integration_time, lens, mixed_pixels, fixed_pattern]"
    config.write_text(f"bootstraps: 19\nmost_pixels: 8000\ncatalogue: {effects}\n")
    arguments = ["--recording", str(time_missing.path), "--out", str(tmp_path / "report")]
    done = CliRunner().invoke(command, [*arguments, "--config", str(config)])
    assert done.exit_code == 0, done.output
    assert "integration_time" in done.output
    assert (tmp_path / "report" / "report.html").is_file()
    before = torch.get_rng_state()
    alone = diagnose(time_missing, config=config)
    assert json.loads((tmp_path / "report" / "diagnosis.json").read_text()) == alone.to_mapping()
    assert torch.equal(torch.get_rng_state(), before)  # Whose draws are the caller's.


def test_the_shipped_configuration_is_what_happens_without_one() -> None:
    shipped = Path(__file__).parents[2] / "configs" / "diagnose" / "default.yaml"
    assert resolve_options(DiagnosisOptions, shipped) == DiagnosisOptions()


@pytest.mark.slow
def test_page_and_simulation_can_be_left_out(time_missing: Recording, tmp_path: Path) -> None:
    diagnose(time_missing, config={"simulate_anew": False, "page": False}, out=tmp_path / "report")
    names = sorted(path.name for path in (tmp_path / "report").iterdir())
    assert names == ["diagnosis.json", "sensor.yaml", "simulator_with_effects.yaml"]
    found = json.loads((tmp_path / "report" / "diagnosis.json").read_text())
    assert found.keys() >= KEYS_AGREED
    assert found["effects"] == ["integration_time"]
    assert found["transfer_mm"] is None
