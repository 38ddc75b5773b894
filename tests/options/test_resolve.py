"""A configuration is named, read from a file or given as a mapping, and changed key by key."""

from pathlib import Path
from typing import Any

import pytest
import yaml

from tofcorr.comparison.options import EvaluationOptions, SelectionOptions
from tofcorr.diagnosis.options import DiagnosisOptions
from tofcorr.errors import ConfigError
from tofcorr.options import Options, resolve_options, shipped_names
from tofcorr.simulation.options import SimulatorOptions
from tofcorr.training.calibration import TrainingOptions

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
COMPARISONS: list[type[Options]] = [EvaluationOptions, SelectionOptions]
CLASSES = [TrainingOptions, *COMPARISONS, SimulatorOptions, DiagnosisOptions]
SHIPPED = [
    pytest.param(cls, name, id=f"{cls.config_folder}/{name}")
    for cls in CLASSES
    for name in shipped_names(cls.config_folder)
]


@pytest.mark.parametrize(("cls", "name"), SHIPPED)
def test_name_file_mapping_and_options_mean_the_same(cls: type[Options], name: str) -> None:
    path = CONFIGS / cls.config_folder / f"{name}.yaml"
    expected = resolve_options(cls, path)
    mapping = yaml.safe_load(path.read_text(encoding="utf-8"))
    for config in (name, str(path), path, mapping, expected):
        assert resolve_options(cls, config) == expected
    # Options that were written out and read again are the same options.
    assert resolve_options(cls, expected.to_mapping()) == expected


def test_every_shipped_file_belongs_to_a_class_and_has_a_name() -> None:
    named = {f"{one.id}.yaml" for one in SHIPPED}
    lenses = {"import/kinect2.yaml"}  # Intrinsics, for `tofcorr import checkerboard --intrinsics`.
    sensors = {"sensor/kinect_v2.yaml"}  # For `tofcorr degrade --sensor`.
    files = {path.relative_to(CONFIGS).as_posix() for path in CONFIGS.glob("*/*")}
    assert named | lenses | sensors == files


def test_changes_reach_mappings_lists_and_keys_that_the_file_leaves_out() -> None:
    plain = resolve_options(TrainingOptions, "ea").to_mapping()
    changes = ["model.terms.0.degree=4", "solver.max_iterations=30", "weights.noise=true"]
    changes += ["name=of = mine", "split={test_fraction: 0.25}"]
    changed = resolve_options(TrainingOptions, "ea", changes).to_mapping()
    assert changed["model"]["terms"][0]["degree"] == 4
    assert changed["model"]["terms"][1:] == plain["model"]["terms"][1:]
    assert changed["solver"] == plain["solver"] | {"max_iterations": 30}
    assert changed["weights"] == plain["weights"] | {"noise": True}
    assert changed["name"] == "of = mine"
    assert changed["split"] == plain["split"] | {"test_fraction": 0.25}


def test_a_change_leads_into_defaults_and_modifies_no_mapping() -> None:
    plain = DiagnosisOptions().to_mapping()
    changed = resolve_options(DiagnosisOptions, "many", ["base.terms.0.degree=5"]).to_mapping()
    assert changed["base"]["terms"][0] == plain["base"]["terms"][0] | {"degree": 5}
    assert changed["base"]["terms"][1:] == plain["base"]["terms"][1:]
    assert changed["page"] is False
    values = {"name": "D", "model": {"terms": [{"kind": "distance_polynomial", "degree": 3}]}}
    options = resolve_options(TrainingOptions, values, ["model.terms.0.degree=1"])
    assert options.to_mapping()["model"]["terms"][0]["degree"] == 1
    assert values["model"] == {"terms": [{"kind": "distance_polynomial", "degree": 3}]}


def test_a_shipped_name_comes_before_a_folder_or_file_so_called(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("ea").mkdir()
    Path("eb").write_text("name: of the file\nmodel: {terms: []}\n")
    assert resolve_options(TrainingOptions, "ea").name == "EA"
    assert resolve_options(TrainingOptions, "eb").name == "EB"
    for config in ("./eb", Path("eb")):
        assert resolve_options(TrainingOptions, config).name == "of the file"


@pytest.mark.parametrize(
    ("config", "changes", "message"),
    [
        ("eaa", [], r"^eaa: neither a file .* shipped for 'train'\. Did you mean 'ea'\? .*bspline"),
        ("far/ea.yaml", [], r"Did you mean 'ea'\?"),
        ("zzzzzzz", [], r"shipped for 'train'\. Shipped: bspline, .*zones\.$"),
        ("z" * 300, [], r"^z{300}: neither a file nor"),
        (Path("ea"), [], r"^ea: there is no such file"),
        ({"nam": 1}, [], r"^the configuration: .*'nam' is not a known key\. Did you mean 'name'"),
        (DiagnosisOptions(), [], r"^expected TrainingOptions, got DiagnosisOptions"),
        ("ea", ["solver.max_iteration=3"], r"ea\.yaml with .*Did you mean 'max_iterations'\?"),
        ("ea", ["solver.max_iterations=many"], r"'solver\.max_iterations': .*got 'many'"),
        ("ea", ["model.terms.7.degree=4"], r"'model\.terms\.7': .*its entries are 0 to 2"),
        ("ea", ["model.terms.-1.degree=4"], r"'model\.terms\.-1': .*its entries are 0 to 2"),
        ("ea", ["name.first=X"], r"'name\.first': 'name' is the value 'EA', which has no entries"),
        ("ea", ["name"], r"^'name': expected KEY=VALUE"),
        ("ea", ["=3"], r"^'=3': expected KEY=VALUE"),
        ("ea", ["solver..kind=3"], r"expected KEY=VALUE"),
        ("ea", ["name=[1"], r"^'name=\[1': not valid YAML"),
    ],
)
def test_what_cannot_be_resolved_is_refused_in_words(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, config: Any, changes: list[str], message: str
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError, match=message):
        resolve_options(TrainingOptions, config, changes)


@pytest.mark.parametrize("word", ["yes", "no"])
def test_a_bare_yes_or_no_means_the_word(word: str) -> None:
    # YAML reads both as booleans, which were refused with "should be 'auto', 'yes' or 'no'".
    found = resolve_options(TrainingOptions, "ea", [f"hand_eye.estimate={word}"])
    assert found.hand_eye.estimate == word
