"""What the pt2 export compiles corrects as the corrector does, before any compiler sees it."""

from typing import Any

import pytest
import torch
from correction.export.c_code.models import STATES, hard_frames

from tofcorr.correction.corrector import DepthCorrector


@pytest.mark.parametrize("depth_kind", ["radial", "z"])
@pytest.mark.parametrize("name", STATES)
def test_what_is_compiled_corrects_as_the_corrector(name: str, depth_kind: Any) -> None:
    # It loads torch's compiler, for seconds: only in the worker that runs this test.
    from tofcorr.correction.export.pt2 import CompilableCorrector

    state = STATES[name](depth_kind)
    corrector = DepthCorrector.from_state(state)
    compiled = CompilableCorrector(corrector)
    for depth, amplitude in zip(*hard_frames(state, 20, seed=5), strict=True):
        expected, expected_valid = corrector(depth, amplitude)
        corrected, valid = compiled(depth, amplitude)
        assert torch.equal(valid.bool(), expected_valid)
        # The largest special depth is 3e38 m, of which float32 keeps seven digits.
        torch.testing.assert_close(corrected, expected, rtol=1e-6, atol=1e-6, equal_nan=True)
