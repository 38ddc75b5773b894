"""Two recordings without noise, of a robot that stops and of one that does not."""

import pytest
from simulation.effects.scenes import FEW, Scene, plain_inputs

from tofcorr.simulation.effects.base import EffectInputs


@pytest.fixture(scope="session")
def at_rest(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return Scene(tmp_path_factory.mktemp("rest"), FEW)


@pytest.fixture(scope="session")
def moving(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    changes = FEW | {"robot": FEW["robot"] | {"motion": "continuous"}}
    changes |= {"conditions": {"frame_interval_s": 0.3}}
    return Scene(tmp_path_factory.mktemp("moving"), changes)


@pytest.fixture(scope="session")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> EffectInputs:
    """Four poses before a checkerboard."""
    return plain_inputs(tmp_path_factory.mktemp("plain"), "checkerboard", 4)
