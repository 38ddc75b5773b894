"""Comparisons meet garbage as a training does, so that tables and reports do not contradict."""

from dataclasses import replace

import numpy as np
import pytest
from simulated_walls import simulated_wall

import tofcorr
from tofcorr.comparison.options import EvaluationOptions
from tofcorr.data.recording import Recording
from tofcorr.options import resolve_options
from tofcorr.pixels.dataset import Dataset
from tofcorr.plausibility.examine import examine
from tofcorr.training.calibration import TrainingOptions

OPTIONS = {"models": [{"name": "EA", "config": "ea"}], "folds": 0}


@pytest.fixture(scope="module")
def clean(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    few = (("white", 8), ("checkerboard", 8))
    return simulated_wall(tmp_path_factory.mktemp("garbage") / "clean", seed=5, shots=few).first


@pytest.fixture(scope="module")
def garbage(clean: Recording) -> Recording:
    """The recording with 2 % of its pixels half a metre too far."""
    far = np.random.default_rng(5).random(clean.depth.shape) < 0.02
    return replace(clean, depth=np.array(clean.depth) + np.float32(0.5) * far)


@pytest.mark.slow
def test_garbage_hardly_changes_a_table(clean: Recording, garbage: Recording) -> None:
    """The table said 63 mm where the report of a training said 7."""
    evaluated = (tofcorr.evaluate(one, OPTIONS).sets[0] for one in (clean, garbage))
    without, found = (one.estimate("half", "rms_mm", "EA").mean for one in evaluated)
    report = tofcorr.train(garbage, resolve_options(TrainingOptions, "ea", ["advice=0"])).report
    assert found < 1.2 * without
    assert found == pytest.approx(report["error_mm"]["after"]["test"]["rms"], rel=0.2)


def test_options_that_choose_the_pixels_keep_them(clean: Recording, garbage: Recording) -> None:
    found, nothing = (examine(Dataset((one,))) for one in (garbage, clean))
    options = resolve_options(EvaluationOptions, OPTIONS)
    met = options.against_garbage(found)
    assert met.mask == "ransac"
    assert [met.training(model).weights.robust for model in met.models] == ["cauchy"]
    assert EvaluationOptions.from_mapping(met.to_mapping(), "again") == met
    own = options.model_copy(update={"outlier_window_mm": 60.0})
    assert own.against_garbage(found) is own
    assert options.against_garbage(None) is options.against_garbage(nothing) is options
