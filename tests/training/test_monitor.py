"""What TensorBoard shows is what happened."""

from pathlib import Path

import numpy as np
import pytest
import torch
from synthetic_scene import EA, Scene, make_scene, write_scene
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from tofcorr.correction.model import CalibrationModel, HandEye
from tofcorr.error_terms.model import ErrorModel, ErrorModelOptions
from tofcorr.estimation.solvers import Solution
from tofcorr.fit.fitting import fit
from tofcorr.fit.problem import Fit
from tofcorr.pixels.dataset import Dataset, covered_domain
from tofcorr.pixels.metrics import frame_errors
from tofcorr.pixels.sample import errors_along_ray, sample_pixels, thinned
from tofcorr.training.calibration import Calibration, TrainingOptions
from tofcorr.training.figures import coloured
from tofcorr.training.monitor import RunMonitor, loss_parts

TRAIN, TEST = np.arange(0, 20), np.arange(20, 28)
REPORT = {
    "model": "EA",
    "stopped": "converged",
    "message": "Converged: all is well.",
    "error_mm": {
        "before": {
            "train": {"mean_abs": 12.345, "rms": 2.0},
            "test": {"mean_abs": None, "rms": None},
        }
    },
    "warnings": ["A warning."],
}


class Run:
    """One small training, watched."""

    def __init__(self, folder: Path) -> None:
        generator = torch.Generator().manual_seed(0)
        self.scene: Scene = make_scene(generator, EA, num_frames=28)
        guess = self.scene.truth.moved(torch.full((self.scene.truth.size,), 0.01).double())
        recording = write_scene(self.scene, folder / "wall", guess.tool_from_camera)
        self.dataset = Dataset((recording,))
        domain = covered_domain(self.dataset, TRAIN)
        options = TrainingOptions.from_mapping({"name": "EA", "model": EA}, "test")
        self.iterations: list[Solution] = []
        monitor = RunMonitor()

        def watch(iteration: Solution) -> None:
            monitor.iteration(iteration)
            self.iterations.append(iteration)

        self.fit: Fit = fit(self.dataset, TRAIN, options, domain, watch)
        nothing = ErrorModel(ErrorModelOptions(), domain)
        geometry = HandEye(self.fit.hand_eye_only.tool_from_camera)
        self.stages = {
            "before": CalibrationModel(nothing, HandEye(recording.tool_from_camera)),
            "hand_eye_only": CalibrationModel(nothing, geometry),
            "after": self.fit.model,
        }
        self.calibration = Calibration(
            data=self.dataset,
            fit=self.fit,
            train=TRAIN,
            test=TEST,
            stages=self.stages,
            errors=frame_errors(self.dataset, self.stages),
        )
        monitor.write(folder / "tb", self.calibration, REPORT)
        self.shown = EventAccumulator(str(folder / "tb"))
        self.shown.Reload()

    def scalar(self, tag: str) -> list[float]:
        return [event.value for event in self.shown.Scalars(tag)]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    return Run(tmp_path_factory.mktemp("run"))


def test_loss_hand_eye_and_every_coefficient_are_shown_by_iteration(run: Run) -> None:
    number = len(run.iterations)
    losses = [iteration.loss for iteration in run.iterations]
    assert run.scalar("convergence/loss_m2") == pytest.approx(losses, rel=1e-6)
    tags = run.shown.Tags()["scalars"]
    coefficients = [tag for tag in tags if tag.startswith("coefficients_mm/")]
    # A column's c^1 and a distance's c1 are two coefficients, and so must their tags be.
    assert len(coefficients) == len(run.fit.moments.symbols)
    by_iteration = [tag for tag in tags if not tag.startswith("error_mm_against/")]
    # One step further stands the estimate: TensorBoard and report.json disagreed.
    for tag in by_iteration:
        assert len(run.scalar(tag)) == number + (not tag.startswith("convergence/")), tag
    estimate = run.fit.solution.parameters
    last = dict(zip(run.fit.moments.symbols, estimate.coefficients, strict=True))
    for symbol, tag in (("c1", "c1"), ("c^1", "c_to_the_1"), ("i2", "i2")):
        shown = run.scalar(f"coefficients_mm/{tag}")[-1]
        assert shown == pytest.approx(1e3 * float(last[symbol]), rel=1e-6)
    moved = estimate.tool_from_camera - run.iterations[0].parameters.tool_from_camera
    assert run.scalar("hand_eye_since_start/t_z_mm")[-1] == pytest.approx(
        1e3 * float(moved[2, 3]), rel=1e-5
    )
    assert run.scalar("hand_eye_since_start/rotation_deg")[0] == 0.0


def test_the_last_rms_shown_is_that_of_the_training_frames(run: Run) -> None:
    errors = run.calibration.errors["after"]
    assert run.scalar("rms_mm/all")[-1] == pytest.approx(errors.rms_mm(TRAIN), rel=1e-6)
    for target, own in (("white", TRAIN[::2]), ("checkerboard", TRAIN[1::2])):
        shown = run.scalar(f"rms_mm/target_{target}")[-1]
        assert shown == pytest.approx(errors.rms_mm(own), rel=1e-6)


def test_the_parts_between_and_within_images_are_those_of_the_pixels(run: Run) -> None:
    scene, parameters = run.scene, run.scene.truth
    parts = loss_parts(scene.moments(), parameters, np.array(["white"] * 28))
    residual = scene.residual(parameters).detach()
    between = within = 0.0
    for image, valid in zip(residual, scene.batch.valid, strict=True):
        used = image[valid]
        between += len(used) * float(used.mean()) ** 2
        within += float((used - used.mean()).square().sum())
    count = int(scene.batch.valid.sum())
    assert parts["between_images"] == pytest.approx(1e3 * (between / count) ** 0.5, rel=1e-6)
    assert parts["within_images"] == pytest.approx(1e3 * (within / count) ** 0.5, rel=1e-6)
    assert parts["all"] ** 2 == pytest.approx(
        parts["between_images"] ** 2 + parts["within_images"] ** 2
    )
    assert parts["target_white"] == pytest.approx(parts["all"])


def test_error_images_distributions_and_the_report_are_there(run: Run) -> None:
    (image,) = run.shown.Images("frames/error_before_and_after")
    assert min(image.width, image.height) > 300
    (words,) = run.shown.Tensors("frames/error_before_and_after/text_summary")
    assert b"held out" in words.tensor_proto.string_val[0]
    stages = ("before", "hand_eye_only", "after")
    expected = {f"error_mm/{stage}_{half}" for stage in stages for half in ("fitted", "held_out")}
    assert set(run.shown.Tags()["histograms"]) == expected
    text = run.shown.Tensors("report/text_summary")[0].tensor_proto.string_val[0].decode()
    for part in ("EA", "Converged: all is well.", "12.35", "–", "A warning."):
        assert part in text


def test_curves_are_means_of_the_sampled_errors_in_bins_of_their_covariate(run: Run) -> None:
    sample = sample_pixels(run.dataset, run.stages, np.sort(np.concatenate([TRAIN, TEST])))
    (tag,) = [t for t in run.shown.Tags()["scalars"] if t.endswith("/distance_x1000/after")]
    x, error = sample.covariates["distance [m]"], sample.errors_mm["after"]
    low, high = np.quantile(x, [0.001, 0.999])
    edges = np.linspace(low, high, 31)
    events = run.shown.Scalars(tag)
    assert len(events) > 3
    for event in events:
        bin_number = np.digitize(event.step / 1e3, edges)
        inside = np.digitize(x, edges) == bin_number
        assert event.value == pytest.approx(error[inside].mean(), rel=1e-4, abs=1e-4)


def test_colours_run_from_blue_to_red_and_unused_pixels_are_grey() -> None:
    image = coloured(np.array([[-9.0, 0.0, 9.0, np.nan]]), limit=2.0)
    assert image[0].tolist() == [[33, 102, 172], [247, 247, 247], [178, 24, 43], [190, 190, 190]]


def test_errors_are_measured_minus_true_along_the_ray(run: Run) -> None:
    """Without noise or error terms left, the truth of the scene gives the drawn errors back."""
    generator = torch.Generator().manual_seed(3)
    scene = make_scene(generator, EA, num_frames=4, noise=0.0)
    bare = CalibrationModel(
        ErrorModel(ErrorModelOptions(), run.fit.domain), HandEye(scene.truth.tool_from_camera)
    )
    found, cosine = errors_along_ray(run.dataset, bare, scene.batch)
    assert scene.batch.amplitude is not None
    with torch.no_grad():
        drawn = 1e3 * scene.model(scene.batch.radial_distance, scene.batch.amplitude)
    used = scene.batch.valid
    torch.testing.assert_close(found[used], drawn[used], rtol=0.0, atol=1e-9)
    assert found[~used].isnan().all()
    assert (cosine < 0).all()


def test_a_sample_holds_usable_pixels_of_the_frames_asked_for(run: Run) -> None:
    sample = sample_pixels(run.dataset, run.stages, TEST)
    assert set(sample.frame) == set(TEST)
    assert len(sample.frame) <= int(run.scene.batch.valid[TEST].sum())
    for values in (*sample.covariates.values(), *sample.errors_mm.values()):
        assert values.shape == sample.frame.shape
        assert np.isfinite(values).all()
    assert sample.covariates["row [pixel]"].max() == 8
    assert sample.covariates["column [pixel]"].max() == 11
    spread = {stage: values.std() for stage, values in sample.errors_mm.items()}
    assert spread["after"] < spread["hand_eye_only"]


def test_thinning_keeps_both_ends_and_never_exceeds_its_number() -> None:
    assert thinned(np.arange(100), 3).tolist() == [0, 50, 99]
    assert thinned(np.arange(3), 5).tolist() == [0, 1, 2]


def test_a_recording_without_amplitudes_is_watched_all_the_same(run: Run, tmp_path: Path) -> None:
    blind = Dataset((write_scene(run.scene, tmp_path / "wall", amplitude=None),))
    sample = sample_pixels(blind, {"before": run.stages["before"]}, TEST)
    assert not any("amplitude" in name for name in sample.covariates)


def test_the_numbers_are_kept_when_a_figure_fails(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(_: Calibration) -> None:
        raise RuntimeError("in the middle")

    monkeypatch.setattr("tofcorr.training.monitor.frames_to_show", fail)
    monitor = RunMonitor()
    monitor.iteration(run.iterations[0])
    with pytest.raises(RuntimeError, match="in the middle"):
        monitor.write(tmp_path, run.calibration)
    shown = EventAccumulator(str(tmp_path))
    shown.Reload()
    assert shown.Scalars("convergence/loss_m2")[0].value == pytest.approx(
        run.iterations[0].loss, rel=1e-6
    )


def test_without_figures_only_they_are_missing(run: Run, tmp_path: Path) -> None:
    monitor = RunMonitor()
    for iteration in run.iterations:
        monitor.iteration(iteration)
    monitor.write(tmp_path, run.calibration, REPORT, figures=False)
    shown = EventAccumulator(str(tmp_path))
    shown.Reload()
    missing = {
        kind: set(run.shown.Tags()[kind]) - set(shown.Tags()[kind])
        for kind in ("scalars", "tensors")
    }
    assert all(tag.startswith("error_mm_against/") for tag in missing["scalars"])
    assert missing["tensors"] == {"frames/error_before_and_after/text_summary"}
    assert shown.Tags()["images"] == []
    assert shown.Tags()["histograms"] == []
