"""A folder of images becomes a recording, or is refused in one sentence."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from importing.checkerboard.imported_board import ERROR, PLACEMENTS, Run, read_image, report
from importing.checkerboard.rendered_board import (
    CAMERA,
    angle_deg,
    placement,
    radial_distance,
    rays,
    varied_placements,
    write_view,
)
from optional import present

from tofcorr.data.recording import Recording


def test_planes_depth_amplitude_mask_and_the_report_are_what_was_rendered(
    rendered: Path, run: Run, tmp_path: Path
) -> None:
    code, out, stderr = run(rendered)
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
        np.testing.assert_array_equal(present(recording.amplitude)[i], counts)
        assert 300 < present(recording.mask)[i].sum() < 0.5 * counts.size
    assert "cannot tell focal length, square length and slope" in stderr
    assert report(tmp_path)["warnings"][-1] in stderr
    for view in report(tmp_path)["views"]:
        # Along the axis the error is less, by the cosine of a ray to the board: at least 0.97.
        assert view["depth_error_mm"] == pytest.approx(1e3 * ERROR, abs=1.5)
        assert view["corners_used"] == 35
        assert view["reprojection_rms_px"] < 0.15


def test_the_camera_can_be_calibrated_from_the_boards(tmp_path: Path, run: Run) -> None:
    folder = tmp_path / "images"
    for i, where in enumerate(varied_placements(12, seed=21)):
        write_view(folder, f"{i}", where)
    code, _, stderr = run(folder, lens=("--calibrate",))
    assert code == 0
    assert "The focal length of 12 views" in stderr
    about = report(tmp_path)["camera"]
    # Rendered corners carry a bias of some hundredths of a pixel that no deviation knows of.
    np.testing.assert_allclose(about["K"], CAMERA.matrix, atol=3.0)


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
