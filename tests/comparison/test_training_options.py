"""Models are compared with all of their training options, and no held-out image takes part."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from comparison.evaluated import compared, options
from synthetic_scene import EA, Scene, write_scene

from tofcorr.comparison.experiment import ModelFitter
from tofcorr.comparison.options import SelectionOptions
from tofcorr.comparison.select import select
from tofcorr.data.recording import Recording
from tofcorr.fit.fitting import fit
from tofcorr.pixels.dataset import Dataset
from tofcorr.pixels.passes import FittedModel
from tofcorr.pixels.sample import usable_pixels

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


@pytest.fixture(scope="module")
def recording(scene: Scene, tmp_path_factory: pytest.TempPathFactory) -> Recording:
    folder = tmp_path_factory.mktemp("scene") / "wall"
    nearly = scene.truth.moved(torch.full((scene.truth.size,), 0.003).double())
    return write_scene(scene, folder, nearly.tool_from_camera)


@pytest.fixture(scope="module")
def shuffled(recording: Recording) -> Recording:
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
    return replace(recording, depth=depth, amplitude=amplitude)


def fitted(recording: Recording, kind: str, frames: np.ndarray = TRAIN) -> FittedModel:
    asked = options({"name": "EA", "model": EA} | KINDS[kind])
    held_out = np.setdiff1d(np.arange(recording.num_frames), frames)
    return ModelFitter(Dataset((recording,)), asked).fit(asked.models[0], frames, held_out)


def unknowns(found: FittedModel) -> torch.Tensor:
    with torch.no_grad():
        transform = found.model.hand_eye().flatten()
    return torch.cat([transform, found.model.error.coefficient_vector()])


@pytest.fixture(scope="module", params=KINDS)
def found(recording: Recording, request: pytest.FixtureRequest) -> tuple[str, torch.Tensor]:
    """Each kind of fit, and its unknowns."""
    return request.param, unknowns(fitted(recording, request.param))


def test_held_out_images_leave_the_fit_bit_identical(
    recording: Recording, shuffled: Recording, found: tuple[str, torch.Tensor]
) -> None:
    kind, own = found
    assert torch.equal(own, unknowns(fitted(shuffled, kind)))
    if kind == "plain":
        # A fit that saw them would be another one.
        seen = (fitted(one, kind, np.arange(8, 32)) for one in (recording, shuffled))
        assert float(torch.sub(*map(unknowns, seen)).abs().max()) > 1e-3


def test_a_model_is_fitted_as_a_training_on_the_same_frames_would_fit_it(
    recording: Recording, found: tuple[str, torch.Tensor]
) -> None:
    kind, own = found
    asked = options({"name": "EA", "model": EA} | KINDS[kind])
    dataset, training = Dataset((recording,)), asked.training(asked.models[0])
    robust = training.weights.robust != "none"
    used = usable_pixels(dataset, training, robust=robust, frames=TRAIN)
    expected = fit(used, TRAIN, training, ModelFitter(dataset, asked).domain).model
    expected = unknowns(FittedModel(expected, HELD_OUT))
    torch.testing.assert_close(own, expected, rtol=0, atol=1e-6)


def misplaced(recording: Recording) -> Dataset:
    """The recording with every wall recorded 30 mm from where it stands."""
    table = recording.frames
    return Dataset((replace(recording, frames=replace(table, offset=table.offset + 0.03)),))


def test_a_comparison_of_unknown_planes_judges_by_the_walls_found_in_training_images(
    recording: Recording,
) -> None:
    planes = {"known": "known", "found": "unknown"}
    models = [{"name": name, "model": EA, "planes": one} for name, one in planes.items()]
    right = compared("wall", Dataset((recording,)), options(models[0], folds=0))
    expected = right.values["half"]["mean_abs_mm"]["known"][0]
    unknown = options(*models, folds=0, planes="unknown")
    by_walls = compared("wall", misplaced(recording), unknown)
    by_walls_found = by_walls.values["half"]["mean_abs_mm"]["found"][0]
    assert by_walls_found == pytest.approx(expected, rel=0.1)
    # Hand-eye and constant can follow a shift common to all walls only in part.
    by_record = compared("wall", misplaced(recording), options(*models, folds=0))
    assert by_record.values["half"]["mean_abs_mm"]["found"][0] > 2 * expected


def test_a_wall_that_no_training_image_shows_is_warned_of(recording: Recording) -> None:
    values = {"models": [{"name": "EA", "model": EA}], "planes": "unknown", "by": ["target"]}
    found = select(recording, SelectionOptions.from_mapping(values, "test"), force=True)
    assert "no training image shows the wall 'white'" in " ".join(found.experiment.warnings)
