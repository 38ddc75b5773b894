"""A new effect is one file and one line of the registry."""

import json

from extending.extension import Extension


def test_a_new_effect_is_simulated_from_yaml_and_named_by_the_diagnosis(
    extension: Extension,
) -> None:
    folder = extension.folder_of("stripes")
    report = json.loads((folder / "report/diagnosis.json").read_text(encoding="utf-8"))
    assert report["effects"] == ["stripes"]
