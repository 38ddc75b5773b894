"""Images are paired by name, never by order."""

from pathlib import Path
from typing import Any

import pytest

from tofcorr.errors import CalibrationDataError
from tofcorr.importing.images import files_of_views


def find_pairs(folder: Path, depth: str, infrared: str) -> Any:
    return files_of_views(folder, {"depth": depth, "infrared": infrared})


def touch(folder: Path, *names: str) -> Path:
    for name in names:
        path = folder / name
        path.parent.mkdir(exist_ok=True, parents=True)
        path.touch()
    return folder


def test_views_come_in_natural_order_named_by_all_wildcards_together(tmp_path: Path) -> None:
    touch(tmp_path, *(f"{n}_{kind}.png" for n in (10, 2, 1) for kind in ("depth", "ir")))
    pairs, refused = find_pairs(tmp_path, "{view}_depth.png", "{view}_ir.png")
    assert list(pairs) == ["1", "2", "10"]
    assert refused == {}
    touch(tmp_path, "run1_003_d.png", "run1_003_i.png", "run2_003_d.png", "run2_003_i.png")
    pairs, _ = find_pairs(tmp_path, "run?_*_d.png", "run?_*_i.png")
    assert list(pairs) == ["1-003", "2-003"]


@pytest.mark.parametrize("pattern", ["{}/{{view}}.png", "{}/*.png"])
def test_images_may_lie_in_folders_of_their_own(tmp_path: Path, pattern: str) -> None:
    touch(tmp_path, "depth/a.png", "ir/a.png", "ir/notes.txt")
    pairs, _ = find_pairs(tmp_path, pattern.format("depth"), pattern.format("ir"))
    assert pairs == {"a": {"depth": tmp_path / "depth/a.png", "infrared": tmp_path / "ir/a.png"}}


def test_a_lost_image_costs_its_own_view_only(tmp_path: Path) -> None:
    touch(tmp_path, "1_depth.png", "1_ir.png", "2_depth.png", "3_ir.png", "4_depth.png", "4_ir.png")
    pairs, refused = find_pairs(tmp_path, "*_depth.png", "*_ir.png")
    assert list(pairs) == ["1", "4"]
    assert refused == {
        "2": "2_depth.png has no infrared image beside it",
        "3": "3_ir.png has no depth image beside it",
    }


@pytest.mark.parametrize(
    ("depth", "infrared", "message"),
    [
        ("{view}_range.png", "{view}_ir.png", r"no file matches depth pattern.*'1_depth.png'"),
        ("1_depth.png", "{view}_ir.png", "names one file; put {view}"),
        ("{view}_depth.png", "1_{view}.png", "has images of each kind: "),
    ],
)
def test_patterns_that_pair_nothing_are_refused(
    tmp_path: Path, depth: str, infrared: str, message: str
) -> None:
    touch(tmp_path, "1_depth.png", "1_ir.png")
    with pytest.raises(CalibrationDataError, match=message):
        find_pairs(tmp_path, depth, infrared)


def test_a_missing_or_empty_folder_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CalibrationDataError, match="no such folder"):
        find_pairs(tmp_path / "nowhere", "*_d.png", "*_i.png")
    with pytest.raises(CalibrationDataError, match="the folder is empty"):
        find_pairs(tmp_path, "*_d.png", "*_i.png")
