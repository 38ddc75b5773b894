"""The ranking of models: robust where pixels are gross outliers, and the same in any order."""

import numpy as np
import pytest
from comparison.asked import options, rewritten
from simulated_walls import simulated_wall

from tofcorr.comparison.experiment import held_out_experiment
from tofcorr.comparison.options import HAND_EYE_ONLY, SelectionOptions
from tofcorr.comparison.select import rank_models
from tofcorr.pixels.dataset import Dataset


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
        held_out_experiment("wall", dataset, asked).values["half"]["mean_abs_mm"]
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
    for name, one in first.errors.items():
        assert one.mean == pytest.approx(second.errors[name].mean, rel=1e-6)
    either = [
        held_out_experiment("wall", spoilt, options(*models, **ON_THE_WALL)).values["half"]
        for models in (both, both[::-1])
    ]
    for column in (HAND_EYE_ONLY, "EA", "EA robust"):
        values = [half["mean_abs_mm"][column] for half in either]
        np.testing.assert_allclose(values[0], values[1], rtol=1e-6)
