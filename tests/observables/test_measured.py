"""Noise and missing pixels of one recording, against an independent camera."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy_camera import REFERENCE, Camera, Truth, record
from scipy.ndimage import gaussian_filter1d

from tofcorr.data.recording import Recording, repeats_of
from tofcorr.data.writing import write_recording
from tofcorr.estimation.noise import NoiseModel, filter_width, neighbour_correlation
from tofcorr.observables.measure import (
    DropoutMeasurement,
    DropoutModel,
    NoiseMeasurement,
    level_of_repeats,
)
from tofcorr.observables.read import Observed

AMPLITUDES = np.array([300.0, 1000.0, 2000.0])


def drawn_and_measured(
    folder: Path, camera: Camera, seed: int, **how: int
) -> tuple[Truth, NoiseMeasurement]:
    truth = record(folder, camera, seed, **how)
    return truth, NoiseMeasurement(Observed(truth.recording))


@pytest.mark.parametrize("repeats", [1, 4])
def test_noise_curve_follows_the_camera_at_every_amplitude(repeats: int, tmp_path: Path) -> None:
    camera = Camera(times=1.7)
    _, noise = drawn_and_measured(tmp_path / "wall", camera, 1, repeats=repeats)
    assert noise.source == ("neighbours" if repeats == 1 else "repeats")
    measured = noise.curve.temporal_sigma(np.ones(3), AMPLITUDES)
    # 24 x 1280 pixels in 24 bins: 2 % of each, and the curve's shape.
    np.testing.assert_allclose(measured, camera.sigma(AMPLITUDES), rtol=0.06)


def test_noise_at_the_edges_of_squares_is_measured_not_extrapolated(tmp_path: Path) -> None:
    """A third of these pixels, the darker ones, has no second difference: 9 % were lost here."""
    truth, found = drawn_and_measured(tmp_path / "one", Camera(), 0)
    assert found.temporal_m == pytest.approx(truth.noise, rel=0.03)
    # A quarter mixes two squares, or is next to a pixel that does.
    assert np.isfinite(found.variance).mean() > 0.7


def test_structure_of_bright_pixels_does_not_lower_the_noise_of_dark_ones() -> None:
    """One level for all was taken: saturated patches made the noise of a camera 13 % too small."""
    rng = np.random.default_rng(7)
    brightness = np.exp(rng.uniform(0.0, 4.0, 40_000))
    noise = 1e-5 / brightness
    structure = np.where(brightness > 30.0, 1e-4, 0.0)
    repeats = np.where(np.arange(40_000) < 8_000, noise * rng.chisquare(2, 40_000) / 2, np.nan)
    neighbours = 1.1 * noise + structure
    found = neighbours * level_of_repeats(brightness, repeats, neighbours)
    # A level of 500 pixels is known to 5 %; those next to the step of the structure are left out.
    for low, high in ((1.0, 5.0), (5.0, 25.0), (36.0, 54.0)):
        there = (brightness > low) & (brightness < high)
        assert found[there].mean() == pytest.approx(noise[there].mean(), rel=0.1)


def test_without_repeats_neighbours_keep_their_level() -> None:
    unknown = np.full(500, np.nan)
    assert (level_of_repeats(np.ones(500), unknown, np.ones(500)) == 1).all()


@pytest.mark.parametrize(("repeats", "poses", "within"), [(4, 12, 0.05), (5, 2, 0.1)])
def test_a_camera_that_mixes_frames_is_known_and_its_single_frame_too(
    repeats: int, poses: int, within: float, tmp_path: Path
) -> None:
    """By two poses, too: fewer than three were taken to show none, and noise was too small."""
    how = {"repeats": repeats, "poses": poses}
    truth, mixing = drawn_and_measured(tmp_path / "mixed", Camera(mixed_frames=0.6), 5, **how)
    assert mixing.frame_correlation == pytest.approx(0.6, abs=within)
    assert mixing.temporal_m == pytest.approx(truth.noise, rel=within)
    _, fresh = drawn_and_measured(tmp_path / "fresh", Camera(), 5, **how)
    assert fresh.frame_correlation == 0.0


@pytest.mark.parametrize("repeats", [1, 4])
def test_filtered_noise_and_fixed_pattern_are_told_apart(repeats: int, tmp_path: Path) -> None:
    camera = Camera(filter_px=0.8, pattern=1e-3)
    _, noise = drawn_and_measured(tmp_path / "wall", camera, 2, repeats=repeats)
    assert noise.pattern_m == pytest.approx(1e-3, rel=0.1)
    assert noise.curve.correlation_px == pytest.approx(0.8, abs=0.08)
    measured = noise.curve.temporal_sigma(np.ones(3), AMPLITUDES)
    np.testing.assert_allclose(measured, camera.sigma(AMPLITUDES), rtol=0.1)


@pytest.mark.parametrize("seed", [3, 4])
def test_a_pattern_without_noise_is_all_of_the_noise(seed: int, tmp_path: Path) -> None:
    """Less the pattern, neighbours left a little more than nothing, or less (3): it stopped.

    What is left follows no law: each pose's surface takes another smooth share of the pattern.
    """
    _, noise = drawn_and_measured(tmp_path / "still", Camera(times=0.0, pattern=4e-3), seed)
    assert noise.temporal_m < 0.03 * noise.pattern_m
    whole = noise.curve.sigma(np.ones(3), AMPLITUDES)
    np.testing.assert_allclose(whole, noise.pattern_m, rtol=0.3)
    assert noise.pattern_m == pytest.approx(4e-3, rel=0.1)


@pytest.mark.parametrize(("threshold", "base"), [(150.0, 0.01), (36.0, 0.0)])
def test_missing_pixels_give_share_threshold_and_base_share(
    threshold: float, base: float, tmp_path: Path
) -> None:
    """Of a camera that loses few pixels, too: bins of equal count were 13 % off there."""
    truth = record(tmp_path / "wall", Camera(threshold=threshold, base_share=base), 3)
    dropouts = DropoutMeasurement(Observed(truth.recording))
    assert dropouts.share == pytest.approx(truth.missing_share, abs=1e-6)
    assert dropouts.model.amplitude_at_half == pytest.approx(threshold, rel=0.03)
    assert dropouts.model.base_share == pytest.approx(base, abs=0.003)


def test_white_filter_widths_are_those_of_scipy_and_come_back() -> None:
    white = np.zeros(201)
    white[100] = 1.0
    for width in (0.5, 1.0, 2.0):
        kernel = gaussian_filter1d(white, width, truncate=8)
        autocorrelation = np.correlate(kernel, kernel, "full")
        middle = len(autocorrelation) // 2
        expected = autocorrelation[middle + 1 : middle + 3] / autocorrelation[middle]
        found = [neighbour_correlation(width, lag) for lag in (1, 2)]
        np.testing.assert_allclose(found, expected, atol=1e-6)
        assert filter_width(found) == pytest.approx(width, abs=1e-3)


def test_noise_curve_has_the_values_of_its_equation_and_holds_them_in_the_dark() -> None:
    parts: dict[str, Any] = {"floor_m": 1e-3, "shot_m": 2e-3, "read_m": 3e-3, "fixed_share": 0.19}
    at_reference: dict[str, Any] = {"reference_amplitude": REFERENCE, "reference_distance_m": 1.0}
    curve = NoiseModel(**parts, **at_reference, least_brightness=0.1, correlation_px=0.0)
    at = np.array([4000.0, 1000.0, 100.0, 1.0])
    squares = np.array([1 + 4 / 4 + 9 / 16, 1 + 4 + 9, 1 + 40 + 900, 1 + 40 + 900])
    np.testing.assert_allclose(curve.sigma(np.ones(4), at), 1e-3 * np.sqrt(squares))
    np.testing.assert_allclose(curve.temporal_sigma(np.ones(4), at), 0.9e-3 * np.sqrt(squares))
    with pytest.raises(ValueError, match="depends on the amplitude"):
        curve.sigma(np.ones(4))


@pytest.mark.parametrize("kind", [np.array, torch.tensor])
@pytest.mark.parametrize("width", [0.1, 0.005])
def test_half_of_the_pixels_is_missing_at_the_threshold_however_sharp(
    width: float, kind: Callable[[list[float]], Any]
) -> None:
    # Near 0.3 m pixels are a thousand times brighter than the threshold: the power overflowed.
    model = DropoutModel(base_share=0.1, amplitude_at_half=200.0, width=width)
    found = model.probability(kind([1e-3, 200.0, 1e6]))
    np.testing.assert_allclose(found, [1.0, 0.55, 0.1], atol=1e-6)


def test_the_amplitude_of_a_missing_pixel_that_states_none_follows_from_its_neighbours(
    tmp_path: Path,
) -> None:
    """Many cameras write an amplitude of zero where they write no distance."""
    drawn = record(tmp_path / "drawn", Camera(threshold=400.0), 4).recording
    # On a wall of one reflectivity the light falls off with distance and angle alone.
    white = np.flatnonzero(drawn.frames.target == "white")
    rows, depth = drawn.frames.rows(), drawn.depth[white]
    amplitude = drawn.require("amplitude", "this test")
    stated = np.where(np.isnan(depth), 0.0, amplitude[white]).astype(np.float32)
    write_recording(
        tmp_path / "stated",
        camera=drawn.camera,
        depth_kind=drawn.depth_kind,
        rows=[rows[k] for k in white],
        depth=depth,
        amplitude=stated,
    )
    found = DropoutMeasurement(Observed(Recording.open(tmp_path / "stated")))
    table = found.observed.table
    # A pose with hardly a distance shows no wall, and so no angle.
    few = np.bincount(table.pose, table.missing == 0) < 100
    lost = (table.missing > 0) & ~few[table.pose]
    wanted = amplitude[white].reshape(-1)
    assert 0.05 < lost.mean() < 0.5
    # The camera states amplitudes to 1 %; its lens takes a cosine squared, the law a polynomial.
    np.testing.assert_allclose(found.amplitude[lost], wanted[lost], rtol=0.06)
    assert found.model.amplitude_at_half == pytest.approx(400.0, rel=0.02)


def test_many_pixels_that_share_the_largest_amplitude_are_saturated(tmp_path: Path) -> None:
    truth = record(tmp_path / "wall", Camera(saturation=1200.0), 4)
    assert truth.recording.saturation_amplitude is None
    found = DropoutMeasurement(Observed(truth.recording))
    assert found.model.saturation_amplitude == 1200.0
    assert found.saturated_missing == pytest.approx(truth.missing_share)
    assert found.model.base_share == 0.0


def test_frames_without_pose_id_belong_together_where_nothing_moves(tmp_path: Path) -> None:
    recording = record(tmp_path / "wall", Camera(), 4, poses=3, repeats=2).recording
    assert [group.tolist() for group in repeats_of(recording)] == [[0, 1], [2, 3], [4, 5]]
    lines = (recording.path / "frames.csv").read_text().splitlines()
    column = lines[0].split(",").index("pose_id")
    kept = [",".join(c for k, c in enumerate(line.split(",")) if k != column) for line in lines]
    (recording.path / "frames.csv").write_text("\n".join(kept) + "\n")
    reopened = type(recording).open(recording.path)
    assert reopened.frames.pose_id is None
    assert [group.tolist() for group in repeats_of(reopened)] == [[0, 1], [2, 3], [4, 5]]
