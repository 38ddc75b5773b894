"""A training that several tests look at; done once."""

import pytest
from simulated_walls import simulated_wall
from training.trained import CONFIG, Trained

import tofcorr


@pytest.fixture(scope="session")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Trained:
    folder = tmp_path_factory.mktemp("trained")
    data = simulated_wall(folder / "wall", seed=7)
    result = tofcorr.train(data.first.path, CONFIG, out=folder / "run")
    return Trained(data, result, folder / "run")
