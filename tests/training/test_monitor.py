"""What TensorBoard shows is what happened."""

from copy import copy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from synthetic_scene import DOMAIN, EA, make_scene, write_scene
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from training.trained import Trained

from tofcorr.correction.model import CalibrationModel, HandEye
from tofcorr.error_terms.model import ErrorModel, ErrorModelOptions
from tofcorr.pixels.dataset import Dataset
from tofcorr.pixels.sample import PixelSample, errors_along_ray, thinned


@pytest.fixture(scope="module")
def shown(trained: Trained) -> EventAccumulator:
    return _read(trained.folder / "tb")


def _read(folder: Path) -> EventAccumulator:
    found = EventAccumulator(str(folder))
    found.Reload()
    return found


def _scalar(shown: EventAccumulator, tag: str) -> list[float]:
    return [event.value for event in shown.Scalars(tag)]


def test_loss_hand_eye_and_every_coefficient_are_shown_by_iteration(
    trained: Trained, shown: EventAccumulator
) -> None:
    iterations, fit = trained.result.iterations, trained.result.fit
    losses = [iteration.loss for iteration in iterations]
    assert _scalar(shown, "convergence/loss_m2") == pytest.approx(losses, rel=1e-6)
    tags = shown.Tags()["scalars"]
    coefficients = [tag for tag in tags if tag.startswith("coefficients_mm/")]
    # A column's c^1 and a distance's c1 are two coefficients, and so must their tags be.
    assert len(coefficients) == len(fit.moments.symbols)
    by_iteration = [tag for tag in tags if not tag.startswith(("error_mm_against/", "1_"))]
    # One step further stands the estimate: TensorBoard and report.json disagreed.
    for tag in by_iteration:
        number = len(iterations) + (not tag.startswith("convergence/"))
        assert len(_scalar(shown, tag)) == number, tag
    estimate = fit.solution.parameters
    last = dict(zip(fit.moments.symbols, estimate.coefficients, strict=True))
    for symbol, tag in (("c1", "c1"), ("c^1", "c_to_the_1"), ("i2", "i2")):
        value = _scalar(shown, f"coefficients_mm/{tag}")[-1]
        assert value == pytest.approx(1e3 * float(last[symbol]), rel=1e-6)
    moved = 1e3 * (estimate.tool_from_camera - iterations[0].parameters.tool_from_camera)[2, 3]
    found = _scalar(shown, "hand_eye_since_start/t_z_mm")[-1]
    assert found == pytest.approx(float(moved), rel=1e-5)
    assert _scalar(shown, "hand_eye_since_start/rotation_deg")[0] == 0.0


def test_the_first_group_shows_the_errors_of_the_stages(
    trained: Trained, shown: EventAccumulator
) -> None:
    tags = shown.Tags()["scalars"]
    assert min(tags) < "a"
    for step, (stage, errors) in enumerate(trained.report()["error_mm"].items()):
        found = _scalar(shown, f"1_result/rms_mm_held_out_{step}_{stage}")
        assert found == pytest.approx([errors["test"]["rms"]])


def test_error_images_distributions_and_the_report_are_there(
    trained: Trained, shown: EventAccumulator
) -> None:
    for name in ("frame", "poses", "covariates", "image", "hand_eye"):
        (image,) = shown.Images(f"1_result/picture_{name}")
        assert min(image.width, image.height) >= 200
    stages = ("before", "hand_eye_only", "after")
    expected = {f"error_mm/{stage}_{half}" for stage in stages for half in ("fitted", "held_out")}
    assert set(shown.Tags()["histograms"]) == expected
    text = shown.Tensors("report/text_summary")[0].tensor_proto.string_val[0].decode()
    text = " ".join(text.split())  # Long lines are wrapped.
    report = trained.report()
    before = report["error_mm"]["before"]["train"]["mean_abs"]
    for part in (report["message"], f"{before:.2f}", report["reason"]):
        assert " ".join(part.split()) in text


def test_curves_are_means_of_the_sampled_errors_in_bins_of_their_covariate(
    trained: Trained, shown: EventAccumulator
) -> None:
    found = trained.result.calibration
    sample = PixelSample(trained.data, found.stages, found.frames)
    tags = [tag for tag in shown.Tags()["scalars"] if "/distance_x1000/" in tag]
    (tag,) = [tag for tag in tags if tag.endswith("/after")]
    x, error = sample.covariates["distance [m]"], sample.errors_mm["after"]
    low, high = np.quantile(x, [0.001, 0.999])
    edges = np.linspace(low, high, 31)
    events = shown.Scalars(tag)
    assert len(events) > 3
    for event in events:
        inside = np.digitize(x, edges) == np.digitize(event.step / 1e3, edges)
        assert event.value == pytest.approx(error[inside].mean(), rel=1e-4, abs=1e-4)


def test_errors_are_measured_minus_true_along_the_ray(tmp_path: Path) -> None:
    """Without noise or error terms left, the truth of the scene gives the drawn errors back."""
    scene = make_scene(torch.Generator().manual_seed(3), EA, num_frames=4, noise=0.0)
    data = Dataset((write_scene(scene, tmp_path / "wall", amplitude=None),))
    hand_eye = HandEye(scene.truth.tool_from_camera)
    bare = CalibrationModel(ErrorModel(ErrorModelOptions(), DOMAIN), hand_eye)
    found, cosine = errors_along_ray(data, bare, scene.batch)
    assert scene.batch.amplitude is not None
    with torch.no_grad():
        drawn = 1e3 * scene.model(scene.batch.radial_distance, scene.batch.amplitude)
    used = scene.batch.valid
    torch.testing.assert_close(found[used], drawn[used], rtol=0.0, atol=1e-9)
    assert found[~used].isnan().all()
    assert (cosine < 0).all()
    assert not any("amplitude" in name for name in PixelSample(data, {"b": bare}, [1]).covariates)


def test_a_sample_holds_usable_pixels_and_thinning_keeps_both_ends(trained: Trained) -> None:
    found, camera = trained.result.calibration, trained.data.first.camera
    sample = PixelSample(trained.data, found.stages, found.test)
    assert set(sample.frame) == set(found.test)
    for values in (*sample.covariates.values(), *sample.errors_mm.values()):
        assert values.shape == sample.frame.shape
        assert np.isfinite(values).all()
    assert sample.covariates["row [pixel]"].max() == camera.height - 1
    assert sample.covariates["column [pixel]"].max() == camera.width - 1
    assert sample.errors_mm["after"].std() < sample.errors_mm["hand_eye_only"].std()
    assert thinned(np.arange(100), 3).tolist() == [0, 50, 99]
    assert thinned(np.arange(3), 5).tolist() == [0, 1, 2]


def test_without_figures_only_they_are_missing(
    trained: Trained, shown: EventAccumulator, tmp_path: Path
) -> None:
    result, monitor = trained.result, copy(trained.result.monitor)
    # Rounding takes the loss of a fit that took all points to the camera below zero: a traceback.
    monitor.iterations = [replace(one, history=(-1e-18,)) for one in monitor.iterations]
    monitor.write(tmp_path, result.calibration, result.report, None, {})
    less, whole = _read(tmp_path).Tags(), shown.Tags()
    missing = {kind: set(whole[kind]) - set(less[kind]) for kind in ("scalars", "tensors")}
    assert all(tag.startswith("error_mm_against/") for tag in missing["scalars"])
    assert missing["tensors"] == set()
    assert less["images"] == less["histograms"] == []
