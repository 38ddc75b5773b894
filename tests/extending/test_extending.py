"""A term, effect, importer, format or check is one file and one line: the pages on adding one.

Each page's file goes into a copy of the package, its line into the registry, and every other Python
block runs there. Nothing else of the package is touched.
"""

import json
from pathlib import Path

import numpy as np
import pytest
from docs.pages import ADDING, title
from extending.conftest import Extension

from tofcorr.data.recording import Recording


def test_the_copy_is_what_runs(extension: Extension) -> None:
    assert extension.printed_by("whose").strip() == str(extension.root)


@pytest.mark.parametrize("page", ADDING, ids=title)
def test_example_takes_one_file_and_one_line(page: Path, extension: Extension) -> None:
    extension.printed_by(page.stem)


def test_a_new_term_trains_loads_and_deploys(extension: Extension) -> None:
    found = json.loads(extension.printed_by("term").splitlines()[-1])
    errors = found["errors"]
    assert errors["after"]["test"]["rms"] < errors["hand_eye_only"]["test"]["rms"]
    assert found["symbols"][:2] == ["c0", "q1"]
    assert found["same"]
    assert found["apart"] < 1e-6


def test_a_new_effect_is_simulated_from_yaml_and_diagnosed(extension: Extension) -> None:
    folder = extension.folder_of("stripes")
    report = json.loads((folder / "report/diagnosis.json").read_text(encoding="utf-8"))
    assert report["effects"] == ["stripes"]


def test_a_new_format_is_written_by_the_module_and_by_the_command(extension: Extension) -> None:
    folder = extension.folder_of("ros_command")
    assert (folder / "module.sh").read_text() == (folder / "command.sh").read_text()
    help_text = " ".join(extension.printed_by("ros_command").split())
    assert "ros_command (.sh): publishes the hand-eye transform in ROS 2." in help_text


def test_a_new_importer_is_a_sub_command_with_report_and_refusals(extension: Extension) -> None:
    assert "Depth and planes in NPZ files." in extension.printed_by("import_help")
    folder, printed = extension.folder_of("add-importer"), extension.printed_by("add-importer")
    assert printed.splitlines()[0] == "3 of 4 views imported to wall"
    reason = "depth_mm, normal or offset is missing"
    assert f"refused broken.npz: {reason}" in printed
    depth = Recording.open(folder / "wall").depth
    np.testing.assert_allclose(depth[:, 0, 0], [1.0, 1.1, 1.2], rtol=1e-6)
    report = json.loads((folder / "wall/import.json").read_text(encoding="utf-8"))
    assert [view["view"] for view in report["views"]] == ["0.npz", "1.npz", "2.npz"]
    assert report["refused"] == [{"view": "broken.npz", "reason": reason}]
