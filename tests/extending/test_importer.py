"""A new importer is one file and one line of the registry: the page's example."""

import json

import numpy as np
from extending.extension import Extension

from tofcorr.data.recording import Recording


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
