"""Real images of a Kinect v2 (`$TOFCORR_REAL_DATA/kinect2_checkerboard`)."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from importing.checkerboard.rendered_board import BOARD, angle_deg
from optional import present

from tofcorr.data.recording import Recording
from tofcorr.geometry.rays import ray_directions
from tofcorr.importing.checkerboard.importer import CheckerboardOptions, import_checkerboard
from tofcorr.importing.intrinsics import intrinsics_from_numbers

INTRINSICS = intrinsics_from_numbers(
    (365.5,), (255.5, 205.0), (0.0905, -0.268, 0.0, 0.0, 0.095), "README"
)


def import_views(real_data: Path, wildcard: str, out: Path) -> tuple[dict[str, Any], Recording]:
    depth, infrared = f"{wildcard}_sync_depth.png", f"{wildcard}_sync_ir.png"
    names = {"depth_pattern": depth, "infrared_pattern": infrared, "amplitude_pattern": infrared}
    options = CheckerboardOptions.from_mapping({**names, "board": BOARD}, "")
    folder = real_data / "kinect2_checkerboard"
    report = import_checkerboard(folder, out, options, INTRINSICS)
    return report, Recording.open(out)


def test_every_tenth_view_is_imported_and_depth_agrees_to_centimetres(
    real_data: Path, tmp_path: Path
) -> None:
    report, recording = import_views(real_data, "0??5", tmp_path / "recording")
    assert report["refused"] == []
    assert recording.num_frames == 10
    rays = ray_directions(recording.camera).numpy()
    images = recording.frames.normal_world, recording.depth, present(recording.mask)
    for view, normal, depth, mask in zip(report["views"], *images, strict=True):
        assert view["reprojection_rms_px"] < 0.2
        assert abs(view["depth_error_mm"]) < 40
        # An independent look at the tilt: the plane through the depth itself.
        seen = (mask > 0) & np.isfinite(depth)
        points = rays[seen] * (depth[seen] / rays[seen][:, 2])[:, None]
        fitted = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2][2]
        assert angle_deg(fitted * np.sign(fitted @ normal), normal) < 10


@pytest.mark.slow
def test_nearly_all_views_are_imported(real_data: Path, tmp_path: Path) -> None:
    report, _ = import_views(real_data, "{view}", tmp_path / "recording")
    assert len(report["views"]) + len(report["refused"]) == 102
    assert len(report["views"]) >= 98
    assert all(refusal["reason"] for refusal in report["refused"])
