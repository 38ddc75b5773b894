"""A folder of images becomes a recording, or is refused in one sentence."""

import json
import re
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from importing.checkerboard.rendered_board import (
    CAMERA,
    angle_deg,
    placement,
    radial_distance,
    rays,
    varied_placements,
    write_view,
)

from tofcorr.cli.main import main
from tofcorr.data.recording import Recording

PLACEMENTS = varied_placements(6)
ERROR = 0.012
FOCAL = ("--focal", "290,288", "--centre", "158.3,121.6")
Run = Callable[..., tuple[int, str, str]]
LENS = (*FOCAL, "--distortion", "0.06,-0.12,0.0008,-0.0005,0.02")


def read_image(path: Path) -> np.ndarray:
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert image is not None
    return image


@pytest.fixture(scope="session")
def rendered(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("rendered") / "images"
    for i, where in enumerate(PLACEMENTS):
        write_view(folder, f"{i}", where, error=ERROR)
    return folder


@pytest.fixture
def images(rendered: Path, tmp_path: Path) -> Path:
    """Rendered views to spoil."""
    return shutil.copytree(rendered, tmp_path / "images")


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> Run:
    """Call the command line; return exit code, standard output and standard error."""

    def call(
        folder: Path, *options: str, board: str = "5x7", lens: Any = LENS
    ) -> tuple[int, str, str]:
        arguments = ["tofcorr", "import", "checkerboard", str(folder), "--board", board]
        arguments += ["--square-mm", "30", "--out", str(tmp_path / "recording"), *lens, *options]
        monkeypatch.setattr(sys, "argv", arguments)
        code = 0
        try:
            main()
        except SystemExit as stop:
            code = int(stop.code or 0)
        out, stderr = capsys.readouterr()
        return code, out, stderr

    return call


def report(tmp_path: Path) -> dict[str, Any]:
    return json.loads((tmp_path / "recording" / "import.json").read_text())


def leftovers(tmp_path: Path) -> list[str]:
    return [p.name for p in tmp_path.iterdir() if p.name not in ("images", "other")]


def test_planes_depth_amplitude_and_mask_are_what_was_rendered(
    rendered: Path, run: Run, tmp_path: Path
) -> None:
    code, out, _ = run(rendered)
    assert code == 0
    assert out.startswith("6 of 6 views imported")
    recording = Recording.open(tmp_path / "recording")
    assert (recording.depth_kind, recording.saturation_amplitude) == ("z", 65535)
    assert not recording.moves
    assert recording.frames.pose_id is None
    assert recording.frames.target.tolist() == ["checkerboard"] * 6
    for i, where in enumerate(PLACEMENTS):
        assert angle_deg(recording.frames.normal_world[i], where.normal) < 0.4
        assert recording.frames.offset[i] == pytest.approx(where.offset, abs=3e-3)
        true_z = (radial_distance(where) + ERROR) * rays(CAMERA)[..., 2]
        np.testing.assert_allclose(recording.depth[i], true_z, atol=0.51e-3)
        counts = read_image(rendered / f"{i}_ir.png")
        assert recording.amplitude is not None
        assert recording.mask is not None
        np.testing.assert_array_equal(recording.amplitude[i], counts)
        assert 300 < recording.mask[i].sum() < 0.5 * counts.size


def test_the_report_states_the_error_that_was_put_in(
    rendered: Path, run: Run, tmp_path: Path
) -> None:
    assert run(rendered)[0] == 0
    views = report(tmp_path)["views"]
    for view in views:
        # Along the axis the error is less, by the cosine of a ray to the board: at least 0.97.
        assert view["depth_error_mm"] == pytest.approx(1e3 * ERROR, abs=1.5)
        assert view["corners_used"] == 35
        assert view["reprojection_rms_px"] < 0.15


def test_the_import_warns_of_what_the_board_cannot_tell_apart(
    rendered: Path, run: Run, tmp_path: Path
) -> None:
    _, _, stderr = run(rendered)
    assert "cannot tell focal length, square length and slope" in stderr
    assert report(tmp_path)["warnings"][-1] in stderr


def test_no_return_is_nan(images: Path, run: Run, tmp_path: Path) -> None:
    depth = read_image(images / "2_depth.png")
    depth[:, :40] = 0
    cv2.imwrite(str(images / "2_depth.png"), depth)
    assert run(images)[0] == 0
    recording = Recording.open(tmp_path / "recording")
    assert np.isnan(recording.depth[2][:, :40]).all()
    assert np.isfinite(recording.depth[2][:, 40:]).all()


def test_the_camera_can_be_calibrated_from_the_boards(tmp_path: Path, run: Run) -> None:
    folder = tmp_path / "images"
    for i, where in enumerate(varied_placements(12, seed=21)):
        write_view(folder, f"{i}", where)
    code, _, stderr = run(folder, lens=("--calibrate",))
    assert code == 0
    assert "The focal length calibrated from 12 views" in stderr
    about = report(tmp_path)["camera"]
    found = np.array([about["K"][0][0], about["K"][1][1], about["K"][0][2], about["K"][1][2]])
    # Rendered corners carry a bias of some hundredths of a pixel that no deviation knows of.
    np.testing.assert_allclose(found, [290.0, 288.0, 158.3, 121.6], atol=3.0)


def spoil_missing(folder: Path) -> None:
    (folder / "3_ir.png").unlink()


def spoil_truncated(folder: Path) -> None:
    path = folder / "3_depth.png"
    path.write_bytes(path.read_bytes()[:500])


def spoil_empty(folder: Path) -> None:
    (folder / "3_ir.png").write_bytes(b"")


def spoil_eight_bit(folder: Path) -> None:
    image = read_image(folder / "3_ir.png")
    cv2.imwrite(str(folder / "3_ir.png"), (image // 256).astype(np.uint8))


def spoil_colour(folder: Path) -> None:
    cv2.imwrite(str(folder / "3_ir.png"), np.zeros((240, 320, 3), np.uint16))


def spoil_size(folder: Path) -> None:
    cv2.imwrite(str(folder / "3_depth.png"), np.full((120, 160), 500, np.uint16))


def spoil_board(folder: Path) -> None:
    cv2.imwrite(str(folder / "3_ir.png"), np.full((240, 320), 500, np.uint16))


def spoil_depth(folder: Path) -> None:
    cv2.imwrite(str(folder / "3_depth.png"), np.zeros((240, 320), np.uint16))


def spoil_mixed_up(folder: Path) -> None:
    write_view(folder.parent / "other", "3", placement(1.2, tilt_x=20))
    shutil.copy(folder.parent / "other" / "3_depth.png", folder / "3_depth.png")


@pytest.mark.parametrize(
    ("spoil", "reason"),
    [
        (spoil_missing, "3_depth.png has no infrared image beside it"),
        (spoil_truncated, "3_depth.png is not a readable image"),
        (spoil_empty, "3_ir.png is not a readable image"),
        (spoil_eight_bit, "3_ir.png has 8 bits a pixel; 16 are needed"),
        (spoil_colour, "3_ir.png has 3 channels"),
        (spoil_size, "3_depth.png has 160x120 pixels, the other images have 320x240"),
        (spoil_board, "no board of 5x7 inner corners found in 3_ir.png"),
        (spoil_depth, "only 0 of "),
        (spoil_mixed_up, "are the two images of the same view?"),
    ],
    ids=lambda value: value.__name__.removeprefix("spoil_") if callable(value) else "",
)
def test_one_spoilt_view_is_refused_with_its_reason_and_the_others_stay(
    images: Path, run: Run, tmp_path: Path, spoil: Callable[[Path], None], reason: str
) -> None:
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


@pytest.mark.parametrize(
    ("spoil", "options", "message"),
    [
        (spoil_all_eight_bit, {}, r"none of 6 views can be imported.*8 bits"),
        (leave, {"board": "6x8"}, "but one of 5x7: count inner corners, not squares"),
        (leave, {"board": "5by7"}, "expected inner corners such as 5x7"),
        (leave, {"board": "2x7"}, "board_columns"),
        (leave, {"lens": ()}, "in one way: --intrinsics FILE"),
        (leave, {"lens": (*FOCAL, "--calibrate")}, "in one way"),
        (leave, {"lens": ("--focal", "290")}, "--focal and --centre go together"),
        (leave, {"lens": ("--focal", "a,b", "--centre", "1,2")}, "separated by commas"),
        (
            leave,
            {"lens": ("--intrinsics", "none.yaml")},
            "none.yaml: neither a file nor a configuration",
        ),
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


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--depth-unit-mm", "0.1"), "times the distance at which the corners place the board"),
        (("--depth", "{view}_range.png"), "no file matches the depth pattern"),
        (("--square-mm", "-1"), "square_length"),
        (("--max-reprojection-px", "0.001"), "0.001 px are allowed"),
    ],
)
def test_wrong_options_are_one_message_and_leave_nothing(
    rendered: Path, run: Run, tmp_path: Path, options: Any, message: str
) -> None:
    code, _, stderr = run(rendered, *options)
    assert code == 2
    assert message in stderr
    assert leftovers(tmp_path) == []


def test_nothing_is_overwritten(rendered: Path, run: Run, tmp_path: Path) -> None:
    (tmp_path / "recording").mkdir()
    (tmp_path / "recording" / "mine.txt").write_text("keep")
    code, _, stderr = run(rendered)
    assert code == 2
    assert "exists already and is not overwritten" in stderr
    assert (tmp_path / "recording" / "mine.txt").read_text() == "keep"
    assert leftovers(tmp_path) == ["recording"]


@pytest.mark.parametrize(("kind", "declared"), [("radial", "z"), ("z", "radial")])
def test_depth_of_the_wrong_kind_is_noticed(
    tmp_path: Path, run: Run, kind: str, declared: str
) -> None:
    aside = [(0.15, 0.05), (-0.15, 0.08), (0.0, 0.0), (0.12, -0.1), (-0.1, -0.1), (0.02, 0.0)]
    for i, shift in enumerate(aside):
        where = placement(0.5, tilt_x=15, tilt_y=10 * (-1) ** i, aside=shift)
        write_view(tmp_path / "images", f"{i}", where, kind=kind)
    code, _, stderr = run(tmp_path / "images", "--depth-kind", declared)
    assert code == 0
    assert f"is depth really '{declared}'?" in stderr
    shutil.rmtree(tmp_path / "recording")
    _, _, stderr = run(tmp_path / "images", "--depth-kind", kind)
    assert "is depth really" not in stderr
