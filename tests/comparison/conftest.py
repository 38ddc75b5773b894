"""A synthetic scene, and its evaluation by three models; done once."""

import pytest
import torch
from comparison.evaluated import compared, options
from synthetic_scene import EA, Scene, make_scene, write_scene

from tofcorr.comparison.experiment import Experiment
from tofcorr.pixels.dataset import Dataset


@pytest.fixture(scope="session")
def scene() -> Scene:
    return make_scene(torch.Generator().manual_seed(0), EA, num_frames=32, noise=0.002)


@pytest.fixture(scope="session")
def dataset(scene: Scene, tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    folder = tmp_path_factory.mktemp("scene") / "wall"
    nearly = scene.truth.moved(torch.full((scene.truth.size,), 0.01).double())
    return Dataset((write_scene(scene, folder, nearly.tool_from_camera),))


@pytest.fixture(scope="session")
def evaluation(dataset: Dataset) -> Experiment:
    asked = options(repeats={"number": 3, "test_fraction": 0.25})
    return compared("wall", dataset, asked)
