"""Comparisons meet garbage as a training does, so that tables and reports do not contradict."""

from pathlib import Path

import numpy as np
import pytest
from simulated_walls import simulated_wall

import tofcorr
from tofcorr.comparison.options import EvaluationOptions
from tofcorr.options import resolve_options
from tofcorr.pixels.dataset import Dataset
from tofcorr.plausibility.examine import examine

OPTIONS = {
    "models": [{"name": "EA", "config": "ea"}],
    "folds": 0,
}


def _held_out(folder: Path) -> float:
    (found,) = tofcorr.evaluate(folder, OPTIONS).sets
    return found.estimate("half", "rms_mm", "EA").mean


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """One recording without and with 2 % of its pixels half a metre too far."""
    folder = tmp_path_factory.mktemp("garbage")
    for name in ("clean", "garbage"):
        simulated_wall(folder / name, seed=5)
    depth = np.load(folder / "garbage" / "depth.npy")
    far = np.random.default_rng(5).random(depth.shape) < 0.02
    np.save(folder / "garbage" / "depth.npy", depth + np.float32(0.5) * far)
    return folder / "clean", folder / "garbage"


def test_garbage_hardly_changes_a_table(folders: tuple[Path, Path]) -> None:
    """The table said 63 mm where the report of a training said 7."""
    clean, garbage = (_held_out(folder) for folder in folders)
    report = tofcorr.train(folders[1], "ea").report
    assert garbage < 1.2 * clean
    assert garbage == pytest.approx(report["error_mm"]["after"]["test"]["rms"], rel=0.2)


def test_options_that_choose_the_pixels_keep_them(folders: tuple[Path, Path]) -> None:
    dataset = Dataset((tofcorr.Recording.open(folders[1]),))
    found = examine(dataset)
    options = resolve_options(EvaluationOptions, OPTIONS)
    met = options.against_garbage(found)
    assert met.mask == "ransac"
    assert [met.training(model).weights.robust for model in met.models] == ["cauchy"]
    assert EvaluationOptions.from_mapping(met.to_mapping(), "again") == met
    own = options.model_copy(update={"outlier_window_mm": 60.0})
    assert own.against_garbage(found) is own
    assert options.against_garbage(None) is options
    clean = examine(Dataset((tofcorr.Recording.open(folders[0]),)))
    assert options.against_garbage(clean) is options
