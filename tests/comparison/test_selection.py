"""The choice of a model: fair groups, paired comparisons, the simplest among equals."""

import json
from pathlib import Path

import numpy as np
import pytest
from simulated_walls import simulated_wall
from synthetic_scene import E0, EA

from tofcorr.comparison.options import SelectionOptions
from tofcorr.comparison.select import select
from tofcorr.comparison.statistics import Ranking
from tofcorr.errors import CalibrationDataError
from tofcorr.pixels.dataset import Dataset

MODELS = [{"name": "E0", "model": E0}, {"name": "EA", "model": EA}]


def options(**values: object) -> SelectionOptions:
    return SelectionOptions.from_mapping({"models": MODELS, **values}, "test")


@pytest.fixture(scope="module")
def wall(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    robot = {"repeat_poses": 2, "repeat_frames": 2}
    return simulated_wall(tmp_path_factory.mktemp("wall") / "wall", robot=robot)


def drawn(seed: int, *means: float) -> dict[str, np.ndarray]:
    """Errors of models on 40 poses: what a pose adds is the same for all of them."""
    random = np.random.default_rng(seed)
    poses = random.normal(5.0, 2.0, 40)
    return {f"m{k}": poses + mean + 0.1 * random.normal(size=40) for k, mean in enumerate(means)}


def test_the_simplest_model_within_a_standard_error_wins_and_the_best_ties() -> None:
    errors = drawn(0, 0.0, 0.0, 1.0)
    errors["m1"] = errors["m0"] + 0.001 * np.random.default_rng(1).normal(size=40) + 1e-5
    ranking = Ranking(errors, {"m0": 20, "m1": 10, "m2": 5}, 6)
    assert ranking.best == "m0"
    assert ranking.winner == "m1"
    assert ranking.ties == ["m0"]


def test_a_difference_far_smaller_than_the_errors_spread_is_seen_because_it_is_paired() -> None:
    ranking = Ranking(drawn(0, 0.0, 0.3), {"m0": 20, "m1": 10}, 6)
    assert ranking.winner == "m0"
    assert ranking.ties == []
    assert ranking.behind["m1"].interval[0] > 0
    assert ranking.errors["m1"].standard_error > 0.3


def test_the_ranking_depends_on_no_order_and_equal_models_are_ranked_by_name() -> None:
    for names in (["b", "a", "c"], ["c", "b", "a"]):
        errors = {name: np.array([1.0, 2.0, 3.0]) for name in names}
        ranking = Ranking(errors, dict.fromkeys(names, 1), 3)
        assert (ranking.best, ranking.winner) == ("a", "a")
    errors, complexity = drawn(0, 0.0, 0.01, 0.02), {"m0": 20, "m1": 10, "m2": 5}
    one, other = (
        Ranking(dict(own), complexity, 6) for own in (errors.items(), [*errors.items()][::-1])
    )
    assert (one.best, one.winner, set(one.ties)) == (other.best, other.winner, set(other.ties))
    assert all(vars(error) == vars(other.errors[name]) for name, error in one.errors.items())


def test_equal_models_are_told_apart_in_fewer_than_one_in_twenty_cases() -> None:
    wrong = sum(Ranking(drawn(seed, 0, 0), {"m0": 1, "m1": 2}, 6).ties == [] for seed in range(200))
    assert wrong <= 10


@pytest.mark.parametrize("by", ["image", "distance", "target"])
def test_each_frame_is_held_out_once_and_poses_stay_together(wall: Dataset, by: str) -> None:
    held_out, skipped = options(by=[by]).splits(wall)
    (groups,) = held_out.values()
    assert not skipped
    assert sorted(np.concatenate(list(groups.values()))) == list(range(wall.num_frames))
    poses = wall.pose_groups()
    together = [set(poses[frames]) for frames in groups.values()]
    assert sum(len(part) for part in together) == len(set(poses))


def test_bands_of_distance_do_not_overlap(wall: Dataset) -> None:
    held_out, _ = options(by=["distance"], distance_bands=4).splits(wall)
    ends = [name.removesuffix(" m").split(" to ") for name in held_out["distance"]]
    flat = [float(end) for pair in ends for end in pair]
    assert flat == sorted(flat)
    assert len(ends) == 4


def test_the_model_that_holds_the_truth_is_chosen(wall: Dataset) -> None:
    selection = select(wall.recordings, options())
    assert selection.decisive.winner == "EA"
    assert selection.decisive.ties == []
    assert sum(map(len, selection.experiment.errors.values())) == 6 + 3 + 2
    assert selection.verdict.startswith("EA is the choice")
    json.dumps(selection.to_mapping(), allow_nan=False)


def test_a_recording_of_one_target_is_not_compared_by_target(tmp_path: Path) -> None:
    dataset = simulated_wall(tmp_path / "white", shots=(("white", 12),))
    held_out, skipped = options().splits(dataset)
    assert set(held_out) == {"image", "distance"}
    assert skipped["target"] == "the recording has one target only."
    with pytest.raises(CalibrationDataError, match="the recording has one target only"):
        options(by=["target"]).splits(dataset)
