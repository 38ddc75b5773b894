"""A view that cannot be used is refused with its reason; a hopeless import in one sentence."""

import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from importing.checkerboard.imported_board import FOCAL, LENS, Run, leftovers, read_image, report
from importing.checkerboard.rendered_board import placement, write_view

from tofcorr.data.recording import Recording


def written(name: str, image: np.ndarray) -> Callable[[Path], object]:
    """Return what puts another image in the place of one."""
    return lambda folder: cv2.imwrite(str(folder / name), image)


def cut(name: str, length: int) -> Callable[[Path], object]:
    return lambda folder: (folder / name).write_bytes((folder / name).read_bytes()[:length])


def spoil_mixed_up(folder: Path) -> None:
    write_view(folder.parent / "other", "3", placement(1.2, tilt_x=20))
    shutil.copy(folder.parent / "other" / "3_depth.png", folder / "3_depth.png")


EVEN = np.full((240, 320), 200, np.uint16)
SPOILT: dict[str, tuple[Callable[[Path], object], str]] = {
    "truncated": (cut("3_depth.png", 500), "3_depth.png is not a readable image"),
    "empty": (cut("3_ir.png", 0), "3_ir.png is not a readable image"),
    "eight bits": (written("3_ir.png", EVEN.astype(np.uint8)), "3_ir.png has 8 bits a pixel"),
    "colour": (written("3_ir.png", np.dstack([EVEN] * 3)), "has shape (240, 320, 3); one channel"),
    "size": (written("3_depth.png", EVEN[:120, :160]), "its depth has 160x120 pixels, the"),
    "board": (written("3_ir.png", EVEN), "no board of 5x7 inner corners found in 3_ir.png"),
    "depth": (written("3_depth.png", 0 * EVEN), "only 0 of "),
    "mixed up": (spoil_mixed_up, "are the two images of the same view?"),
}


@pytest.mark.parametrize("name", SPOILT)
def test_one_spoilt_view_is_refused_with_its_reason_and_the_others_stay(
    images: Path, run: Run, tmp_path: Path, name: str
) -> None:
    spoil, reason = SPOILT[name]
    spoil(images)
    code, out, _ = run(images)
    assert code == 0
    assert "5 of 6 views imported" in out
    (refusal,) = report(tmp_path)["refused"]
    assert refusal["view"] == "3"
    assert reason in refusal["reason"]
    assert f"refused 3: {refusal['reason']}" in out
    assert Recording.open(tmp_path / "recording").num_frames == 5


def spoil_all_eight_bit(folder: Path) -> None:
    for path in folder.glob("*.png"):
        image = read_image(path)
        cv2.imwrite(str(path), (image // 256).astype(np.uint8))


def leave(_: Path) -> None:
    """Spoil nothing."""


def leave_two(folder: Path) -> None:
    """Keep two views: a board that is not there is looked for longest."""
    for path in folder.glob("[2-5]_*.png"):
        path.unlink()


@pytest.mark.parametrize(
    ("spoil", "options", "message"),
    [
        (spoil_all_eight_bit, {}, r"none of 6 views can be imported.*8 bits"),
        (leave_two, {"board": "6x8"}, "but one of 5x7: count inner corners, not squares"),
        (leave, {"board": "5by7"}, "expected 5x7"),
        (leave, {"board": "2x7"}, "columns"),
        (leave, {"lens": ()}, "in one way: --intrinsics FILE"),
        (leave, {"lens": (*FOCAL, "--calibrate")}, "in one way"),
        (leave, {"lens": ("--focal", "290")}, "--focal and --centre go together"),
        (leave, {"lens": ("--focal", "a,b", "--centre", "1,2")}, "separated by commas"),
        (leave, {"lens": ("--intrinsics", "none.yaml")}, "none.yaml: neither a file nor a config"),
        (leave, {"lens": (*LENS, "--depth-unit-mm", "0.1")}, "times the board's distance"),
        (leave, {"lens": (*LENS, "--depth", "{view}_range.png")}, "no file matches depth"),
        (leave, {"lens": (*LENS, "--square-mm", "-1")}, "square_length"),
        (leave, {"lens": (*LENS, "--max-reprojection-px", "0.001")}, "at most 0.001 px"),
    ],
)
def test_a_hopeless_import_is_one_message_and_leaves_nothing(
    images: Path,
    run: Run,
    tmp_path: Path,
    spoil: Callable[[Path], None],
    options: Any,
    message: str,
) -> None:
    spoil(images)
    code, out, stderr = run(images, **options)
    assert code == 2
    assert out == ""
    assert "Traceback" not in stderr
    (line,) = [line for line in stderr.splitlines() if "Error" in line]
    assert message in line or re.search(message, line)
    assert leftovers(tmp_path) == []
