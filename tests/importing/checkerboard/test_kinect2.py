"""Real images of a Kinect v2 (`$TOFCORR_REAL_DATA/kinect2_checkerboard`)."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from importing.checkerboard.rendered_board import angle_deg

from tofcorr.data.recording import Recording, iterate_frames
from tofcorr.geometry.rays import ray_directions, ray_plane_distance
from tofcorr.importing.checkerboard.importer import CheckerboardOptions, import_checkerboard
from tofcorr.importing.intrinsics import intrinsics_from_numbers

INTRINSICS = intrinsics_from_numbers(
    (365.5,), (255.5, 205.0), (0.0905, -0.268, 0.0, 0.0, 0.095), "README"
)


def import_views(real_data: Path, wildcard: str, out: Path) -> tuple[dict[str, Any], Recording]:
    options = CheckerboardOptions(
        depth_pattern=f"{wildcard}_sync_depth.png",
        infrared_pattern=f"{wildcard}_sync_ir.png",
        board_columns=5,
        board_rows=7,
        square_length=0.03,
    )
    folder = real_data / "kinect2_checkerboard"
    report = import_checkerboard(folder, out, options, INTRINSICS)
    return report, Recording.open(out)


def test_every_tenth_view_is_imported_and_depth_agrees_to_centimetres(
    real_data: Path, tmp_path: Path
) -> None:
    report, recording = import_views(real_data, "0??5", tmp_path / "recording")
    assert report["refused"] == []
    assert recording.num_frames == 10
    assert recording.mask is not None
    rays = ray_directions(recording.camera).numpy()
    for view, normal, depth, mask in zip(
        report["views"], recording.frames.normal_world, recording.depth, recording.mask, strict=True
    ):
        assert view["reprojection_rms_px"] < 0.2
        assert abs(view["depth_error_mm"]) < 40
        # An independent look at the tilt: the plane through the depth itself.
        seen = (mask > 0) & np.isfinite(depth)
        points = rays[seen] * (depth[seen] / rays[seen][:, 2])[:, None]
        fitted = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2][2]
        assert angle_deg(fitted * np.sign(fitted @ normal), normal) < 10


@pytest.mark.slow
def test_nearly_all_views_are_imported_and_each_term_lowers_the_held_out_error(
    real_data: Path, tmp_path: Path
) -> None:
    report, recording = import_views(real_data, "{view}", tmp_path / "recording")
    assert len(report["views"]) + len(report["refused"]) == 102
    assert len(report["views"]) >= 98
    assert all(refusal["reason"] for refusal in report["refused"])
    held_out = held_out_rms_mm(recording)
    offset_only, distance, pixel, amplitude = held_out
    assert offset_only > distance > pixel > amplitude
    assert np.all(held_out <= [8.5, 7.65, 6.45, 6.2])


def held_out_rms_mm(recording: Recording, num_splits: int = 100) -> np.ndarray:
    """Ordinary least squares of the point-to-plane residual, offset to + D + P + I by term."""
    moments = np.stack([view_moments(recording, frame) for frame in range(recording.num_frames)])
    generator = np.random.default_rng(0)
    results = []
    for _ in range(num_splits):
        order = generator.permutation(len(moments))
        held_out = moments[order[: len(order) // 3]].sum(axis=0)
        training = moments[order[len(order) // 3 :]].sum(axis=0)
        results.append([rms_mm(training, held_out, columns) for columns in (1, 4, 8, 10)])
    return np.mean(results, axis=0)


def view_moments(recording: Recording, frame: int) -> np.ndarray:
    """Sum of v v' over pixels; v: weighted features, residual, and one for the count."""
    (batch,) = iterate_frames(recording, [frame])
    valid = batch.valid[0]
    rays = ray_directions(recording.camera)
    true = ray_plane_distance(rays, batch.normal_tool, batch.offset_tool)[0]
    measured, cosine = batch.radial_distance[0], -(rays @ batch.normal_tool[0])
    error = (measured - true)[valid].numpy()
    distance = measured[valid].numpy() - 1.0
    row, column = (index.numpy() / 250.0 - 0.9 for index in valid.nonzero(as_tuple=True))
    assert batch.amplitude is not None
    amplitude = batch.amplitude[0][valid].numpy() / 2e4
    features = [np.ones_like(error), distance, distance**2, distance**3]
    features += [row, column, row**2, column**2, amplitude, amplitude**2]
    weight = cosine[valid].numpy()
    vectors = np.stack([*(weight * f for f in features), weight * error, np.ones_like(error)])
    return vectors @ vectors.T


def rms_mm(training: np.ndarray, held_out: np.ndarray, columns: int) -> float:
    used = [*range(columns), 10]
    normal, right = training[:columns, :columns], training[:columns, 10]
    solution = np.append(np.linalg.lstsq(normal, right, rcond=None)[0], -1.0)
    squares = solution @ held_out[np.ix_(used, used)] @ solution
    return float(1e3 * np.sqrt(squares / held_out[11, 11]))
