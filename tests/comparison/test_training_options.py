"""Models are compared with all of their training options, and no held-out image takes part."""

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from simulated_walls import simulated_wall
from synthetic_scene import E0, EA, Scene, make_scene, write_scene

from tofcorr.comparison.evaluation import evaluate_set
from tofcorr.comparison.evaluation_options import HAND_EYE_ONLY, EvaluationOptions
from tofcorr.comparison.held_out_errors import FittedModel, held_out_errors
from tofcorr.comparison.model_fitter import ModelFitter
from tofcorr.comparison.ranking import rank
from tofcorr.comparison.selection import rank_models
from tofcorr.comparison.selection_options import SelectionOptions
from tofcorr.data.recording import Recording
from tofcorr.errors import ConfigError
from tofcorr.fit.fitting import fit
from tofcorr.pixels.dataset import Dataset
from tofcorr.pixels.masks import usable_pixels

TRAIN = np.arange(0, 24)
HELD_OUT = np.arange(24, 32)
KINDS: dict[str, dict[str, Any]] = {
    "plain": {},
    "noise": {"weights": {"noise": True}},
    "huber": {"weights": {"robust": "huber"}},
    "cauchy and noise": {"weights": {"noise": True, "robust": "cauchy"}},
    "window": {"outlier_window_mm": 15.0},
    "window and noise": {"outlier_window_mm": 15.0, "weights": {"noise": True}},
    "ransac": {"mask": "ransac", "mask_tolerance_mm": 20.0},
    "edges": {"edge_contrast": 2.0},
    "grazing": {"grazing_deg": 40.0},
    "unknown walls": {"planes": "unknown"},
    "unknown walls, robust": {"planes": "unknown", "weights": {"robust": "cauchy"}},
}


def options(*models: dict[str, Any], **common: Any) -> EvaluationOptions:
    values = {"models": list(models), "folds": 0} | common
    return EvaluationOptions.from_mapping(values, "test")


def rewritten(recording: Recording, folder: Path, **images: np.ndarray) -> Recording:
    """Copy a recording with other images."""
    shutil.copytree(recording.path, folder)
    for name, values in images.items():
        np.save(folder / f"{name}.npy", values)
    return Recording.open(folder)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return make_scene(torch.Generator().manual_seed(3), EA, num_frames=32, noise=0.002)


@pytest.fixture(scope="module")
def recording(scene: Scene, tmp_path_factory: pytest.TempPathFactory) -> Recording:
    folder = tmp_path_factory.mktemp("scene") / "wall"
    nearly = scene.truth.moved(torch.full((scene.truth.size,), 0.003).double())
    return write_scene(scene, folder, nearly.tool_from_camera)


@pytest.fixture(scope="module")
def shuffled(recording: Recording, tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """The recording with the pixels of held-out images in random order.

    Nothing is left of their geometry; the ranges of distance and amplitude, the one thing that
    a comparison takes from all images, stay as they are.
    """
    random = np.random.default_rng(0)
    size = recording.camera.height * recording.camera.width
    depth, amplitude = (np.array(part) for part in (recording.depth, recording.amplitude))
    for frame in HELD_OUT:
        order = random.permutation(size)
        for images in (depth, amplitude):
            images[frame] = images[frame].reshape(-1)[order].reshape(images[frame].shape)
    folder = tmp_path_factory.mktemp("shuffled") / "wall"
    return rewritten(recording, folder, depth=depth, amplitude=amplitude)


def fitted(recording: Recording, kind: str, frames: np.ndarray = TRAIN) -> FittedModel:
    asked = options({"name": "EA", "model": EA} | KINDS[kind])
    held_out = np.setdiff1d(np.arange(recording.num_frames), frames)
    return ModelFitter(Dataset((recording,)), asked).fit(asked.models[0], frames, held_out)


def unknowns(found: FittedModel) -> torch.Tensor:
    with torch.no_grad():
        transform = found.model.hand_eye().flatten()
    return torch.cat([transform, found.model.error.coefficient_vector()])


@pytest.mark.parametrize("kind", KINDS)
def test_held_out_images_leave_the_fit_bit_identical(
    recording: Recording, shuffled: Recording, kind: str
) -> None:
    assert torch.equal(unknowns(fitted(recording, kind)), unknowns(fitted(shuffled, kind)))


def test_shuffled_images_would_change_a_fit_that_saw_them(
    recording: Recording, shuffled: Recording
) -> None:
    seen = np.arange(8, 32)
    change = unknowns(fitted(recording, "plain", seen)) - unknowns(fitted(shuffled, "plain", seen))
    assert float(change.abs().max()) > 1e-3


@pytest.mark.parametrize("kind", KINDS)
def test_a_model_is_fitted_as_a_training_on_the_same_frames_would_fit_it(
    recording: Recording, kind: str
) -> None:
    asked = options({"name": "EA", "model": EA} | KINDS[kind])
    dataset = Dataset((recording,))
    fitter = ModelFitter(dataset, asked)
    found = fitter.fit(asked.models[0], TRAIN, HELD_OUT)
    training = asked.training(asked.models[0])
    robust = training.weights.robust != "none"
    used = usable_pixels(dataset, training, robust=robust, frames=TRAIN)
    expected = fit(used, TRAIN, training, fitter.domain).model
    torch.testing.assert_close(
        unknowns(found), unknowns(FittedModel(expected, HELD_OUT)), rtol=0, atol=1e-6
    )


@pytest.mark.slow
def test_models_of_the_same_masks_and_weights_share_one_pass_over_the_pixels(
    recording: Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    passes: list[int] = []
    once = Dataset.moments

    def counted(self: Dataset, *arguments: Any, **named: Any) -> Any:
        passes.append(1)
        return once(self, *arguments, **named)

    monkeypatch.setattr(Dataset, "moments", counted)
    plain = [
        {"name": "E0", "model": E0},
        {"name": "EA", "model": EA},
        {"name": "walls", "model": EA, "planes": "unknown"},
    ]
    evaluate_set("wall", Dataset((recording,)), options(*plain, folds=4))
    assert len(passes) == 1
    passes.clear()
    noise = [{"name": f"noise {k}", "model": k, "weights": {"noise": True}} for k in (0, 1)]
    noise = [model | {"model": (E0, EA)[model["model"]]} for model in noise]
    evaluate_set("wall", Dataset((recording,)), options(*plain, *noise, folds=4))
    # The noise is estimated in the training frames of each of the five splits.
    assert len(passes) == 1 + 5


@pytest.fixture(scope="module")
def clean(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return simulated_wall(tmp_path_factory.mktemp("wall") / "wall")


@pytest.fixture(scope="module")
def spoilt(clean: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """The recording with one pixel in fifty off by decimetres, in every image."""
    random = np.random.default_rng(0)
    depth = np.array(clean.first.depth)
    hit = random.uniform(size=depth.shape) < 0.02
    depth[hit] += random.uniform(0.2, 0.6, int(hit.sum())).astype(np.float32)
    folder = tmp_path_factory.mktemp("spoilt") / "wall"
    return Dataset((rewritten(clean.first, folder, depth=depth),))


ROBUST = [
    {"config": "ea", "mask": "recording"},
    {"config": "ea_robust", "mask": "recording"},
]
ON_THE_WALL = {"mask": "ransac", "mask_tolerance_mm": 100.0}


@pytest.mark.slow
def test_robust_weights_win_where_training_pixels_carry_gross_outliers(
    clean: Dataset, spoilt: Dataset
) -> None:
    asked = options(*ROBUST, **ON_THE_WALL)
    outliers, none = (
        evaluate_set("wall", dataset, asked).scores["half"].values["mean_abs_mm"]
        for dataset in (spoilt, clean)
    )
    assert outliers["EA robust"][0] < 0.7 * outliers["EA"][0]
    # Without outliers it pays for the edges and grazing views that it leaves out.
    assert none["EA robust"][0] < 1.15 * none["EA"][0]
    # Outliers in the training images leave the robust fit as it was without them.
    assert outliers["EA robust"][0] == pytest.approx(none["EA robust"][0], rel=0.05)


@pytest.mark.slow
def test_the_ranking_does_not_depend_on_the_order_of_the_models(spoilt: Dataset) -> None:
    few_passes = {"noise": True, "robust": "cauchy", "passes": 2}
    both = [ROBUST[0], ROBUST[1] | {"weights": few_passes}]
    values = {"by": ["image"], "folds": 2} | ON_THE_WALL
    orders = [
        SelectionOptions.from_mapping(values | {"models": models}, "test")
        for models in (both, both[::-1])
    ]
    first, second = (rank_models(spoilt, order).decisive for order in orders)
    assert first.winner == second.winner == "EA robust"
    assert (first.best, first.ties) == (second.best, second.ties)
    for name, one in first.models.items():
        assert one.error == pytest.approx(second.models[name].error, rel=1e-6)
    either = [
        evaluate_set("wall", spoilt, options(*models, **ON_THE_WALL)).scores["half"]
        for models in (both, both[::-1])
    ]
    for column in (HAND_EYE_ONLY, "EA", "EA robust"):
        values = [scores.values["mean_abs_mm"][column] for scores in either]
        np.testing.assert_allclose(values[0], values[1], rtol=1e-6)


def test_models_of_equal_error_and_complexity_are_ranked_by_name() -> None:
    errors = {name: np.array([1.0, 2.0, 3.0]) for name in ("b", "a", "c")}
    for names in (["b", "a", "c"], ["c", "b", "a"]):
        ranking = rank({name: errors[name] for name in names}, dict.fromkeys(names, 1), 3)
        assert (ranking.best, ranking.winner) == ("a", "a")


@pytest.mark.slow
def test_all_models_are_measured_on_the_same_pixels(recording: Recording) -> None:
    models = [{"name": kind, "model": EA} | changes for kind, changes in KINDS.items()]
    asked = options(*models, outlier_window_mm=60.0)
    fitter = ModelFitter(Dataset((recording,)), asked)
    columns = [fitter.fit(model, TRAIN, HELD_OUT) for model in asked.models]
    columns.append(fitter.hand_eye_only(TRAIN, HELD_OUT, HAND_EYE_ONLY))
    counts = [found.to_plane.count for found in held_out_errors(fitter.measured, columns)]
    valid = [int(batch.valid.sum()) for batch in fitter.measured.batches(HELD_OUT)]
    assert all(np.array_equal(count, counts[0]) for count in counts)
    assert counts[0].sum() == sum(valid)


def misplaced(recording: Recording) -> Dataset:
    """The recording with every wall recorded 30 mm from where it stands."""
    table = recording.frames
    return Dataset((replace(recording, frames=replace(table, offset=table.offset + 0.03)),))


def test_a_comparison_of_unknown_planes_judges_by_the_walls_found_in_training_images(
    recording: Recording,
) -> None:
    models = [
        {"name": "known", "model": EA, "planes": "known"},
        {"name": "found", "model": EA, "planes": "unknown"},
    ]
    right = evaluate_set("wall", Dataset((recording,)), options(models[0]))
    expected = right.scores["half"].values["mean_abs_mm"]["known"][0]
    by_walls = evaluate_set("wall", misplaced(recording), options(*models, planes="unknown"))
    by_walls_found = by_walls.scores["half"].values["mean_abs_mm"]["found"][0]
    assert by_walls_found == pytest.approx(expected, rel=0.1)
    # Hand-eye and constant can follow a shift common to all walls only in part.
    by_record = evaluate_set("wall", misplaced(recording), options(*models))
    assert by_record.scores["half"].values["mean_abs_mm"]["found"][0] > 2 * expected


def test_a_wall_that_no_training_image_shows_is_warned_of(recording: Recording) -> None:
    values = {
        "models": [{"name": "EA", "model": EA}],
        "planes": "unknown",
        "by": ["target"],
    }
    asked = SelectionOptions.from_mapping(values, "test")
    found = rank_models(Dataset((recording,)), asked)
    assert any("no training image shows the wall 'white'" in text for text in found.warnings)


def test_a_shipped_training_configuration_gives_its_name_and_every_option() -> None:
    asked = options({"config": "ea_robust", "grazing_deg": 60.0}, {"config": "ea", "name": "mine"})
    robust, mine = (asked.training(model) for model in asked.models)
    assert asked.columns[2:] == ["EA robust", "mine"]
    assert (robust.weights.noise, robust.weights.robust) == (True, "cauchy")
    assert (robust.edge_contrast, robust.grazing_deg) == (2.0, 60.0)
    assert mine.weights.robust == "none"


def test_common_options_complete_a_model_and_its_own_replace_them() -> None:
    asked = options(
        {"name": "a", "model": EA},
        {"name": "b", "model": EA, "hand_eye": {"estimate": "auto"}, "outlier_window_mm": None},
        hand_eye={"estimate": "no"},
        outlier_window_mm=80.0,
        device="cuda",
    )
    a, b = (asked.training(model) for model in asked.models)
    assert (a.hand_eye.estimate, a.outlier_window_mm, a.device) == ("no", 80.0, "cuda")
    assert (b.hand_eye.estimate, b.outlier_window_mm, b.device) == ("auto", None, "cuda")


def test_the_resolved_configuration_can_be_read_again() -> None:
    asked = options({"config": "ea_robust"}, {"name": "b"}, hand_eye={"estimate": "no"})
    again = EvaluationOptions.from_mapping(asked.to_mapping(), "again")
    assert again == asked
    assert [again.training(model) for model in again.models] == [
        asked.training(model) for model in asked.models
    ]


@pytest.mark.parametrize(
    ("model", "message"),
    [
        ({"name": "a", "split": {"seed": 1}}, "'split' cannot differ from model to model"),
        ({"name": "a", "device": "cuda"}, "'device' cannot differ from model to model"),
        ({"config": "ea_rubost"}, "Did you mean 'ea_robust'"),
        ({"config": 3}, "'config' is the name or the file of a training configuration"),
        ({"name": "a", "weight": {}}, "Did you mean 'weights'"),
    ],
)
def test_a_model_that_makes_no_sense_is_refused(model: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        options(model)


def test_a_model_of_a_training_file_is_read_from_there(tmp_path: Path) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text("name: mine\nmodel: {terms: []}\nplanes: unknown\nsplit: {seed: 4}\n")
    asked = options({"config": str(file)})
    assert asked.models[0].planes == "unknown"
    assert asked.models[0].model_fields_set == {"name", "model", "planes"}
