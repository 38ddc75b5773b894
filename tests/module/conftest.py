import pytest
from kinds_of_terms import KINDS
from module.modules import module_of

from tofcorr.module.depth_correction import DepthCorrection


@pytest.fixture(params=KINDS)
def module(request: pytest.FixtureRequest) -> DepthCorrection:
    """A module of one kind of term, with random parameters: every kind in turn."""
    return module_of(request.param)
