"""The models of a comparison: from where their options come, and what is refused."""

from pathlib import Path

from comparison.evaluated import options
from synthetic_scene import EA

from tofcorr.comparison.options import EvaluationOptions


def test_a_shipped_training_configuration_gives_its_name_and_every_option() -> None:
    asked = options({"config": "ea_robust", "grazing_deg": 60.0}, {"config": "ea", "name": "mine"})
    robust, mine = (asked.training(model) for model in asked.models)
    assert asked.columns[2:] == ["EA robust", "mine"]
    assert (robust.weights.noise, robust.weights.robust) == (True, "cauchy")
    assert (robust.edge_contrast, robust.grazing_deg) == (2.0, 60.0)
    assert mine.weights.robust == "none"


def test_common_options_complete_a_model_and_its_own_replace_them() -> None:
    asked = options(
        {"name": "a", "model": EA},
        {"name": "b", "model": EA, "hand_eye": {"estimate": "auto"}, "outlier_window_mm": None},
        hand_eye={"estimate": "no"},
        outlier_window_mm=80.0,
        device="cuda",
    )
    a, b = (asked.training(model) for model in asked.models)
    assert (a.hand_eye.estimate, a.outlier_window_mm, a.device) == ("no", 80.0, "cuda")
    assert (b.hand_eye.estimate, b.outlier_window_mm, b.device) == ("auto", None, "cuda")


def test_the_resolved_configuration_can_be_read_again() -> None:
    asked = options({"config": "ea_robust"}, {"name": "b"}, hand_eye={"estimate": "no"})
    again = EvaluationOptions.from_mapping(asked.to_mapping(), "again")
    assert again == asked
    one, other = ([each.training(model) for model in each.models] for each in (again, asked))
    assert one == other


def test_a_model_of_a_training_file_is_read_from_there(tmp_path: Path) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text("name: mine\nmodel: {terms: []}\nplanes: unknown\nsplit: {seed: 4}\n")
    asked = options({"config": str(file)})
    assert asked.models[0].planes == "unknown"
    assert asked.models[0].model_fields_set == {"name", "model", "planes"}
