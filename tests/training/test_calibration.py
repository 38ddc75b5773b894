"""The calibration says what the corrector does, in the units and symbols it states."""

from typing import Any

import numpy as np
import pytest
import torch
from simulated_walls import true_hand_eye
from torch import Tensor
from training.trained import Trained

from tofcorr.pixels.dataset import Dataset


def error_in_the_papers_symbols(
    groups: dict[str, Any], distance: Any, amplitude: Any, row: Any, column: Any
) -> Any:
    """Return c0 + c1 D + c2 D^2 + c3 D^3 + p1 (r - r0)^2 + p2 (c - c0)^2 + i1 A + i2 A^2."""
    names = ("distance", "pixel", "intensity")
    d, p, i = ({symbol: one["value"] for symbol, one in groups[name].items()} for name in names)
    by_distance = d["c0"] + d["c1"] * distance + d["c2"] * distance**2 + d["c3"] * distance**3
    by_place = p["p1"] * (row - p["r0"]) ** 2 + p["p2"] * (column - p["c0"]) ** 2
    return by_distance + by_place + i["i1"] * amplitude + i["i2"] * amplitude**2


def distances_to_plane_mm(
    data: Dataset, frames: np.ndarray, tool_from_camera: Any, calibration: dict[str, Any] | None
) -> Tensor:
    """Return the distance of every usable pixel to its plane, without the package's model."""
    transform = torch.tensor(tool_from_camera, dtype=torch.float64)
    rays = data.ray_directions()
    found = []
    for batch in data.batches(frames):
        assert batch.amplitude is not None
        frame, row, column = batch.valid.nonzero(as_tuple=True)
        distance = batch.radial_distance[batch.valid]
        if calibration is not None:
            amplitude = batch.amplitude[batch.valid]
            groups = calibration["coefficients"]
            distance = distance - error_in_the_papers_symbols(
                groups, distance, amplitude, row.double(), column.double()
            )
        points = (rays[row, column] * distance[:, None]) @ transform[:3, :3].T + transform[:3, 3]
        found.append((points * batch.normal_tool[frame]).sum(-1) + batch.offset_tool[frame])
    return 1e3 * torch.cat(found)


@pytest.mark.parametrize("half", ["train", "test"])
def test_reported_errors_are_millimetres_to_the_plane(trained: Trained, half: str) -> None:
    report, calibration = trained.report(), trained.calibration()
    frames = np.array(report["frames"][half])
    recorded = np.asarray(trained.data.first.tool_from_camera)
    estimated = report["hand_eye"]["tool_from_camera"]
    stages = (("before", recorded, None), ("after", estimated, calibration))
    for stage, transform, used in stages:
        off = distances_to_plane_mm(trained.data, frames, transform, used)
        told = report["error_mm"][stage][half]
        assert told["mean_abs"] == pytest.approx(float(off.abs().mean()), rel=1e-6)
        assert told["rms"] == pytest.approx(float(off.square().mean().sqrt()), rel=1e-6)


def test_the_hand_eye_is_known_to_its_standard_errors_in_their_units(trained: Trained) -> None:
    hand_eye = trained.report()["hand_eye"]
    found = np.array(hand_eye["tool_from_camera"])
    truth = true_hand_eye(trained.data).numpy()
    apart_mm = 1e3 * (found - truth)[:3, 3]
    turned = found[:3, :3] @ truth[:3, :3].T
    apart_deg = np.degrees([turned[2, 1], turned[0, 2], turned[1, 0]])
    # Six standard errors: with ten and more poses, a chance of one in ten thousand.
    assert (np.abs(apart_mm) < 6 * np.array(hand_eye["translation_se_mm"])).all()
    assert (np.abs(apart_deg) < 6 * np.array(hand_eye["rotation_se_deg"])).all()
    # In metres and radians they would be a thousand and 57 times too small.
    assert (np.array(hand_eye["translation_se_mm"]) > 1e-2).all()
    for name, unit in (("translation", "mm"), ("rotation", "deg")):
        ratio = np.divide(hand_eye[f"{name}_ci95_{unit}"], hand_eye[f"{name}_se_{unit}"])
        assert ((ratio > 1.96) & (ratio < 3)).all()


def test_the_papers_coefficients_reproduce_the_correctors_error(trained: Trained) -> None:
    calibration = trained.calibration()
    assert calibration["sign"] == "error = measured - true; corrected = measured - error"
    corrector = torch.jit.load(trained.folder / "corrector.ts")
    low, high = calibration["validity"]["radial_distance_m"]
    dark, bright = calibration["validity"]["amplitude"]
    height, width = (calibration["camera"][name] for name in ("height", "width"))
    for share in (0.1, 0.5, 0.9):
        distance = low + share * (high - low)
        amplitude = bright - share * (bright - dark)
        depth = torch.full((height, width), distance, dtype=torch.float32)
        corrected, valid = corrector(depth, torch.full_like(depth, amplitude))
        for row, column in ((0, 0), (7, 20), (height - 1, width - 1)):
            at = (distance, amplitude, row, column)
            expected = error_in_the_papers_symbols(calibration["coefficients"], *at)
            error = float(depth[row, column] - corrected[row, column])
            # float32 at one to three metres resolves 2.4e-7 m.
            assert error == pytest.approx(float(expected), abs=1e-6)
            assert bool(valid[row, column])


def test_every_coefficient_has_a_standard_error_and_the_ranges_are_those_of_the_fit(
    trained: Trained,
) -> None:
    calibration = trained.calibration()
    assert (calibration["format"], calibration["version"]) == ("tofcorr-calibration", 1)
    symbols = {name: set(group) for name, group in calibration["coefficients"].items()}
    assert symbols == {
        "distance": {"c0", "c1", "c2", "c3"},
        "pixel": {"p1", "r0", "p2", "c0"},
        "intensity": {"i1", "i2"},
    }
    for group in calibration["coefficients"].values():
        assert all(one["standard_error"] > 0 for one in group.values())
    domain = trained.result.fit.domain
    assert calibration["validity"]["radial_distance_m"] == list(domain.radial_distance)
    assert calibration["hand_eye"] == trained.report()["hand_eye"]
    assert calibration["held_out_error_mm"] == trained.report()["error_mm"]["after"]["test"]
    assert calibration["camera"]["K"] == [list(row) for row in trained.data.first.camera.matrix]
    assert calibration["noise"]["source"] == "neighbours"


def test_the_corrector_of_the_result_is_the_one_on_disk(trained: Trained) -> None:
    (batch,) = trained.data.batches(np.array([4]))
    assert batch.amplitude is not None
    depth, amplitude = batch.radial_distance.float(), batch.amplitude.float()
    expected, expected_valid = torch.jit.load(trained.folder / "corrector.ts")(depth, amplitude)
    found, valid = trained.result.corrector()(depth, amplitude)
    assert torch.equal(valid, expected_valid)
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-6, equal_nan=True)


def test_the_curve_is_the_model_in_the_image_centre(trained: Trained) -> None:
    rows = trained.calibration()["correction_curves"]["distance"]
    error = trained.result.fit.model.error
    centre = (slice(error.height // 2, error.height // 2 + 1), [15, 16])
    for row in rows[::5]:
        size = (error.height, error.width)
        distance = torch.full(size, row["radial_distance_m"], dtype=torch.float64)
        amplitude = torch.full(size, row["amplitude"], dtype=torch.float64)
        with torch.no_grad():
            middle = error(distance, amplitude)[centre].mean()
        # The centre lies between two columns; the pixel term is quadratic, so the mean is close.
        assert row["error_mm"] == pytest.approx(1e3 * float(middle), abs=0.05)
        assert row["standard_error_mm"] > 0
