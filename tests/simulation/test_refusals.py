"""What the simulator refuses leaves nothing behind."""

from pathlib import Path
from typing import Any

import pytest
from simulation.small import small

from tofcorr.errors import ConfigError
from tofcorr.simulation.simulator import simulate


def measured(**delays: Any) -> dict[str, Any]:
    return {"sensor": {"delays": {"measured": delays}}}


@pytest.mark.parametrize(
    ("sections", "message"),
    [
        ({"effects": [{"name": "wigglin"}]}, r"\[0\]: there is no effect 'wigglin'. Did you mean"),
        (
            {"effects": [{"name": "gremlins"}]},
            r"no effect 'gremlins'. Known effects: ambient_light",
        ),
        ({"effects": [{"amplitude_mm": 3}]}, r"effects\[0\]: 'name' is missing"),
        ({"shots": [{"target": "grey"}]}, r"no target 'grey' \(known: white, checkerboard\)"),
        (
            {"robot": {"distance_m": [3.0, 4.0], "farthest_pixel_m": 2.0}},
            "no pose found where the wall fills the image",
        ),
        ({"robot": {"distance_m": [2.0, 1.0]}}, "smallest, 2, exceeds the largest, 1"),
        ({"robot": {"motion": "continuous", "repeat_poses": 2}}, "allows neither repeat_poses"),
        ({"scene": {"plane": {"normal": [0.0, 0.0, 2.0]}}}, "length 1, its length is 2"),
        (
            {"sensor": {"harmonics": [{"order": 3, "share": 0.1}, {"order": 3, "share": 0.2}]}},
            r"each order may appear once only, got \[3, 3\]",
        ),
        (measured(pixel={"values_m": [[0.0, 0.0], [0.0]]}), "rows must have the same length"),
        (measured(distance={"knots": [0, 1], "values_m": [0]}), "2 knots but 1 values_m"),
        (measured(distance={"knots": [1, 0], "values_m": [0, 1]}), "the knots must increase"),
    ],
)
def test_what_cannot_be_simulated_leaves_nothing_behind(
    sections: dict[str, Any], message: str, tmp_path: Path
) -> None:
    with pytest.raises(ConfigError, match=message):
        simulate(small(**sections), tmp_path / "deep/r")
    assert list(tmp_path.iterdir()) == []


def test_more_frames_than_planned_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="8 frames are asked for, but the options plan 7"):
        simulate(small(), tmp_path / "r", num_frames=8)
