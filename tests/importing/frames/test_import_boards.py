"""Boards in a folder of images: a grey image for the corners, and boards of other kinds."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from cameras import rigid
from importing.frames.imported import Imported, run_import
from optional import present
from scipy.spatial.transform import Rotation

PINHOLE = ("--focal", "420", "--centre", "319.5,239.5")
LENS = ("--focal", "365.5", "--centre", "255.5,205", "--distortion", "0.0905,-0.268,0,0,0.095")


def test_real_boards_are_the_same_through_frames_and_through_checkerboard(
    real_data: Path, tmp_path: Path
) -> None:
    folder = real_data / "kinect2_checkerboard"
    depth, infrared = "00?5_sync_depth.png", "00?5_sync_ir.png"
    board = ("--board", "5x7", "--square-mm", "30", *LENS, "--depth", depth)
    given = ("--grey", infrared, "--amplitude", infrared, "--saturation", 65535)
    first = run_import("checkerboard", folder, *board, "--infrared", infrared, out=tmp_path / "one")
    second = run_import("frames", folder, *board, *given, out=tmp_path / "other")
    assert first.done.num_frames > 3
    for name in ("depth", "amplitude", "mask"):
        np.testing.assert_array_equal(getattr(first.done, name), getattr(second.done, name))
    for name in ("normal_world", "offset", "target"):
        mine, theirs = (getattr(one.done.frames, name) for one in (first, second))
        np.testing.assert_array_equal(mine, theirs)
    named = ("reprojection_rms_px", "corners_used", "board_pixels", "distance_m")
    for mine, theirs in zip(first.report["views"], second.report["views"], strict=True):
        assert [mine[key] for key in named] == [theirs[key] for key in named]


def test_corners_are_found_in_a_preview_of_8_bits_and_without_amplitudes(
    real_data: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "images"
    folder.mkdir()
    for path in sorted((real_data / "kinect2_checkerboard").glob("00?5_sync_ir.png")):
        counts = np.asarray(cv2.imread(str(path), cv2.IMREAD_UNCHANGED), dtype=float)
        preview = np.clip(np.log1p(counts) / np.log1p(65535) * 255, 0, 255).astype(np.uint8)
        cv2.imwrite(str(folder / path.name.replace("ir", "grey")), cv2.merge([preview] * 3))
        depth = path.with_name(path.name.replace("ir", "depth"))
        (folder / depth.name).write_bytes(depth.read_bytes())
    imported = import_views(folder, "5x7", *LENS)
    assert imported.done.amplitude is None
    assert imported.done.num_frames > 3
    for view in imported.report["views"]:
        assert view["reprojection_rms_px"] < 0.5
        assert abs(view["depth_error_mm"]) < 40


def import_views(folder: Path, board: str, *more: str) -> Imported:
    """Import views that show a board of 30 mm: `N_depth.png` and `N_grey.png`."""
    images = ("--depth", "*_depth.png", "--grey", "*_grey.png", "--board", board)
    return run_import("frames", folder, *images, "--square-mm", 30, *more, out=folder / "out")


MATRIX = np.array([[420.0, 0.0, 319.5], [0.0, 420.0, 239.5], [0.0, 0.0, 1.0]])


def board_pose(number: int) -> np.ndarray:
    generator = np.random.default_rng(number)
    angles = [*generator.uniform(-30, 30, 2), 20 * number]
    turn = Rotation.from_euler("xyz", angles, degrees=True)
    return rigid(turn, [0.0, 0.0, 0.45 + 0.03 * number])


def write_views(folder: Path, drawn: np.ndarray, size: tuple[float, float], count: int) -> None:
    """Photograph a drawn board of `size` metres around its middle: grey, and its plane's depth."""
    folder.mkdir()
    height, width = drawn.shape
    # A pixel sees about 8 drawn ones: blurred, as by a lens, so that edges are not sampled jagged.
    drawn = cv2.GaussianBlur(cv2.copyMakeBorder(drawn, 40, 40, 40, 40, 0, value=255), (0, 0), 4.5)
    scale = np.diag([size[0] / width, size[1] / height, 1.0])
    scale[:2, 2] = -0.5 * np.array(size) + (0.5 - 40) * np.diag(scale)[:2]
    v, u = np.mgrid[:480, :640].astype(float)
    rays = np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(MATRIX).T
    for number in range(count):
        pose = board_pose(number)
        onto = MATRIX @ pose[:3, [0, 1, 3]] @ scale
        grey = cv2.warpPerspective(drawn, onto, (640, 480), flags=cv2.INTER_LINEAR, borderValue=255)
        if number == 1:
            grey[:, :300] = 128  # Something stands before a part of the board.
        depth = (pose[:3, 2] @ pose[:3, 3]) / (rays @ pose[:3, 2])
        cv2.imwrite(str(folder / f"{number}_grey.png"), grey)
        cv2.imwrite(str(folder / f"{number}_depth.png"), np.round(1e3 * depth).astype(np.uint16))


def draw(kind: str) -> tuple[np.ndarray, tuple[float, float]]:
    """Draw a board with squares or tags of 30 mm by OpenCV's generator, 8 pixels a millimetre."""
    if kind == "charuco":
        words = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
        board = cv2.aruco.CharucoBoard((8, 6), 0.03, 0.0225, words)
        return board.generateImage((1920, 1440)), (0.24, 0.18)
    words = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    board = cv2.aruco.GridBoard((5, 4), 0.03, 0.009, words)
    return board.generateImage((1488, 1176)), (0.186, 0.147)


@pytest.mark.parametrize(
    ("kind", "board"),
    [("charuco", "charuco:8x6:4X4_50:0.75"), ("apriltag", "apriltag:5x4:APRILTAG_36H11:0.3")],
)
def test_other_boards_give_the_plane_even_where_a_part_is_hidden(
    kind: str, board: str, tmp_path: Path
) -> None:
    folder = tmp_path / "views"
    write_views(folder, *draw(kind), count=4)
    imported = import_views(folder, board, *PINHOLE)
    recording = imported.done
    assert [view["view"] for view in imported.report["views"]] == ["0", "1", "2", "3"]
    assert set(recording.frames.target) == {kind}
    for number in range(4):
        pose = board_pose(number)
        normal = -pose[:3, 2] * np.sign(pose[:3, 2] @ pose[:3, 3])
        found = recording.frames.normal_world[number]
        assert np.degrees(np.arccos(min(1.0, found @ normal))) < 0.5
        # At the middle; view 1 shows one half only, and a tenth of a pixel tilts it there by 1 mm.
        assert abs(found @ pose[:3, 3] + recording.frames.offset[number]) < 0.002
        seen = np.asarray(present(recording.mask)[number]) > 0
        assert seen.mean() > 0.03


@pytest.mark.parametrize(
    ("board", "said"),
    [("5by7", "expected 5x7"), ("qr:5x7", "expected 5x7"),
     ("charuco:5x7:9X9:2", "share"), ("charuco:5x7:NOPE", "no dictionary of markers 'NOPE'")],
)  # fmt: skip
def test_boards_that_do_not_exist_are_refused(board: str, said: str, tmp_path: Path) -> None:
    write_views(tmp_path / "views", *draw("charuco"), count=1)
    assert said in import_views(tmp_path / "views", board, *PINHOLE).refusal


def test_planes_come_from_poses_or_from_a_board_and_not_from_both(tmp_path: Path) -> None:
    given = (tmp_path, "--depth", "*", *PINHOLE)
    for more in ((), ("--poses", "p.txt", "--board", "5x7")):
        refused = run_import("frames", *given, *more, out=tmp_path / "o").refusal
        assert "say where the planes come from" in refused
