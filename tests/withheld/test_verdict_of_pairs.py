"""What people read first of a pair: the gap of the simulator as given, not what calibration leaves.

The truth is the withheld generator's, which shares no code with the program.
"""

import json
import re
from pathlib import Path

import pytest

import tofcorr
from benchmarks.withheld.pairs.cases import write_pair

OPTIONS = {"simulate_anew": False, "page": False}


@pytest.mark.slow
@pytest.mark.parametrize("seed", [20, 21, 22])
def test_an_ideal_simulator_is_as_far_off_as_the_errors_of_the_camera(
    seed: int, tmp_path: Path
) -> None:
    """Exact depth and the true hand-eye transform against a camera with D, P and I errors."""
    pair = write_pair(seed, "no_effect", 0, tmp_path)
    truth = json.loads((tmp_path / "answers" / pair["id"] / "answer.json").read_text())["truth"]
    recordings = tmp_path / "recordings"
    found = tofcorr.diagnose(recordings / pair["id"], recordings / pair["sim"], OPTIONS)
    first = re.search(r"(\d+\.\d) mm", found.verdict)
    assert first is not None
    assert float(first[1]) == pytest.approx(truth["as_given_mm"], rel=0.05)
    # Calibrated, hardly anything is left: that number must not lead.
    assert found.gap.before < 0.2e-3 * truth["as_given_mm"]
    assert found.effects == ()
