"""A new kind of error term is one file and one line of the registry."""

import json

from extending.extension import Extension


def test_a_new_term_trains_loads_and_deploys(extension: Extension) -> None:
    found = json.loads(extension.printed_by("root").splitlines()[-1])
    errors = found["errors"]
    assert errors["after"]["test"]["rms"] < errors["hand_eye_only"]["test"]["rms"]
    assert found["symbols"][:2] == ["c0", "root"]
    assert found["same"]
    assert found["apart"] < 1e-6
