"""The page of a training shows what its report says, and needs nothing but itself."""

import base64
import html
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial import KDTree
from scipy.stats import f
from shown_pages import WIDTHS, fetched, looked_at, needs_browser, silent
from training.trained import CONFIG, Trained

import tofcorr
from tofcorr.training.figures import before_walls, ellipse, tile_means
from tofcorr.training.page import cloud


@pytest.fixture(scope="module")
def page(trained: Trained) -> str:
    return (trained.folder / "report.html").read_text(encoding="utf-8")


def words_of(page: str) -> str:
    """The text of a page, without tags, scripts and styles."""
    bare = re.sub(r"<(script|style|svg).*?</\1>", " ", page, flags=re.DOTALL)
    return re.sub(r"\s+", " ", html.unescape(re.sub(r"<[^>]*>", " ", bare)))


def test_the_page_needs_nothing_else_and_every_picture_has_words(page: str) -> None:
    assert fetched(page) == []
    assert silent(page) == 0
    assert page.count("<svg") == 5
    assert len(page) < 1_500_000


def test_the_numbers_at_the_top_are_those_of_the_report(page: str, trained: Trained) -> None:
    report, shown = trained.report(), words_of(page.split("<h2>", maxsplit=1)[0])
    assert shown.index(report["verdict"].capitalize()) < shown.index(report["reason"])
    cards = [float(one) for one in re.findall(r"<b>(?:± )?([\d.]+) mm</b>", page)]
    errors = [report["error_mm"][stage]["test"]["rms"] for stage in report["error_mm"]]
    expected = [*errors, max(report["hand_eye"]["translation_ci95_mm"])]
    # One digit after the point, or two below a millimetre.
    assert cards == pytest.approx(expected, abs=0.05)
    for warning in report["warnings"]:
        assert warning in shown
    assert [shown.index(warning) for warning in report["warnings"]] == sorted(
        shown.index(warning) for warning in report["warnings"]
    )


def test_what_may_be_zero_is_folded_away(page: str, trained: Trained) -> None:
    open_rows, folded = words_of(page).split("Coefficients")[-1].split("that may be zero")
    for named in trained.calibration()["coefficients"].values():
        for symbol, one in named.items():
            clear = abs(one["value"]) > 3 * one["standard_error"]
            if clear or abs(one["value"]) < 1.5 * one["standard_error"]:
                assert f" {symbol} " in (open_rows if clear else folded)


def test_the_ellipse_is_that_of_the_covariance_in_the_report(trained: Trained) -> None:
    hand_eye = trained.report()["hand_eye"]
    covariance = np.array(hand_eye["covariance_mm_deg"])
    errors = [*hand_eye["translation_se_mm"], *hand_eye["rotation_se_deg"]]
    assert np.sqrt(np.diag(covariance)) == pytest.approx(errors)
    own = covariance[:2, :2]
    freedom = trained.result.fit.covariance.degrees_of_freedom
    points = ellipse(own, freedom)
    square = (points * np.linalg.solve(own, points)).sum(axis=0)
    assert square == pytest.approx(2 * f.ppf(0.95, 2, freedom))
    values, vectors = np.linalg.eigh(own)
    ends = np.abs(vectors.T @ points).max(axis=1)
    assert ends == pytest.approx(np.sqrt(square[0] * values), rel=2e-3)


def test_the_points_in_space_are_the_corrected_ones(page: str, trained: Trained) -> None:
    data = json.loads(page.split('id="points">')[1].split("</script>", maxsplit=1)[0])
    calibration, recording = trained.result.calibration, trained.data.first
    frame = int(re.findall(r"The points of frame (\d+)", page)[0])
    rows = {name: decoded(text) for name, text in data["clouds"].items()}
    depth = torch.from_numpy(np.array(recording.depth[frame]))
    amplitude = torch.from_numpy(np.array(recording.require("amplitude", "this test")[frame]))
    corrector = trained.result.corrector()
    _, valid = corrector(depth, amplitude)
    points = corrector.points(depth, amplitude)[valid].numpy()
    # The image is so small that all its pixels are shown.
    distance, which = KDTree(rows["after"][:, :3]).query(points)
    assert distance.max() < 1e-5
    assert len(np.unique(which)) == len(points) > 0.9 * len(rows["after"])
    shown = np.sqrt(np.square(rows["after"][:, 3]).mean())
    errors = calibration.errors["after"].rms_mm(np.array([frame]))
    assert errors < shown < 1.5 * errors  # Along the ray is farther than straight to the wall.
    few = cloud(calibration, frame, most=100)
    assert len(decoded(few["clouds"]["before"])) == 100
    # The wall's corners lie on its plane: four points, two directions.
    wall = np.array(data["wall"])
    assert np.linalg.svd(wall - wall.mean(axis=0))[1][2] < 1e-9


def decoded(text: str) -> np.ndarray:
    """Rows of x, y, z and error."""
    return np.frombuffer(base64.b64decode(text), "<f4").reshape(-1, 4)


def test_cameras_stand_where_they_are_before_their_wall() -> None:
    """A wall at x = 2 that looks to the origin; the camera above it looks straight at it."""
    camera = torch.eye(4, dtype=torch.float64)
    # Columns: right, down and forward of a camera that looks along x with z up.
    camera[:3, :3] = torch.tensor([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]).double()
    beside = camera.clone()
    beside[:3, 3] = torch.tensor([0.5, -0.3, 0.1])
    normal = torch.tensor([[-1.0, 0, 0]] * 3).double()
    plane = normal, torch.full((3,), 2.0).double()
    place, way = before_walls(torch.stack([camera, camera, beside]), plane)
    assert place == pytest.approx(np.array([[0, 0, 2], [0, 0, 2], [0.3, 0.1, 1.5]]))
    assert way == pytest.approx(np.array([[0, 0, -1.0]] * 3))


def test_a_tile_is_the_mean_of_its_pixels() -> None:
    values = np.arange(32 * 16.0).reshape(32, 16)
    known = np.flatnonzero(np.arange(values.size) >= 32)
    tiles = tile_means(known, values.ravel()[known], values.shape)
    expected = values.reshape(16, 2, 8, 2).mean(axis=(1, 3))
    assert np.isnan(tiles[0]).all()
    assert tiles[1:] == pytest.approx(expected[1:])


def test_without_figures_there_is_no_page_and_without_a_robot_no_ellipse(
    trained: Trained, tmp_path: Path
) -> None:
    def run(name: str, **options: Any) -> Path:
        tofcorr.train(trained.recording, CONFIG | options, out=tmp_path / name)
        return tmp_path / name / "report.html"

    assert not run("plain", figures=False).exists()
    fixed = run("fixed", hand_eye={"estimate": "no"}, advice=0).read_text(encoding="utf-8")
    assert 'id="hand_eye"' not in fixed
    assert (fetched(fixed), silent(fixed)) == ([], 0)


@needs_browser
def test_nothing_of_the_page_is_cut_and_its_script_runs(page: str, tmp_path: Path) -> None:
    frames, console = looked_at(page, tmp_path)
    assert console == ""
    for width, seen in zip(WIDTHS, frames, strict=True):
        assert seen["scroll"] <= width
        assert (seen["cut"], seen["silent"]) == ([], [])
