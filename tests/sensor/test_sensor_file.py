"""`sensor.yaml`: what is written is read, and what breaks the format is refused."""

from pathlib import Path
from typing import Any

import pytest
import torch
from sensor.sensors import (
    CAMERA,
    CONDITIONS,
    EFFECTS,
    ERROR,
    NOISE,
    entries,
    plane_scene,
    sensor,
    sensor_values,
)

from tofcorr.errors import ConfigError, StateError
from tofcorr.sensor.model import SensorModel


def test_a_saved_model_measures_what_it_did(tmp_path: Path) -> None:
    model = sensor(
        error=ERROR | {"reads": "measured_distance"},
        effects=entries(*EFFECTS),
        noise=NOISE | {"fixed_share": 0.3, "correlation_px": 0.7},
        dropouts={"base_share": 0.1, "amplitude_at_half": 700.0, "saturation_amplitude": 900.0},
        light={"amplitude_at_1m": 2000.0},
        title="A camera\nof tests.",
        measured_from=["Twelve images."],
    )
    for parameter in model.parameters():
        parameter.data.add_(0.002 * torch.rand(parameter.shape, dtype=torch.float64))
    model.save(tmp_path / "sensor.yaml")
    again = SensorModel.load(tmp_path / "sensor.yaml", torch.float64)
    depth, amplitude, _ = plane_scene()
    with torch.no_grad():
        wanted, found = (
            each(depth, amplitude, generator=torch.Generator().manual_seed(7), **CONDITIONS)
            for each in (model, again)
        )
    # Maps are rounded to 1 um in the file.
    torch.testing.assert_close(found.depth, wanted.depth, rtol=0, atol=2e-6, equal_nan=True)
    assert torch.equal(found.valid, wanted.valid)
    assert 0 < int(wanted.valid.sum()) < wanted.valid.numel()
    text = (tmp_path / "sensor.yaml").read_text(encoding="utf-8")
    assert text.startswith("# A camera of tests.\n# `tofcorr degrade")


def test_a_state_of_another_sensor_is_refused() -> None:
    state = sensor(error=ERROR).state_dict()
    sensor(error=ERROR).load_state_dict(state)
    with pytest.raises(StateError, match="the state is of another model"):
        sensor(effects=entries(*EFFECTS)).load_state_dict(state, strict=False)
    farther = sensor_values()["validity"] | {"radial_distance_m": [0.4, 9.0]}
    with pytest.raises(StateError, match="validity"):
        sensor(error=ERROR, validity=farther).load_state_dict(state)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"version": 2}, "version"),
        ({"format": "tofcorr-calibration"}, "format"),
        ({"nosie": {}}, "Did you mean 'noise'"),
        ({"noise": {"floor_m": -0.1}}, "floor_m"),
        ({"dropouts": {"base_share": 1.4}}, "base_share"),
        ({"validity": {"radial_distance_m": [0.5]}}, "radial_distance_m"),
        ({"validity": {"radial_distance_m": [3, 1]}}, "radial_distance_m.*lower end first"),
        ({"depth_kind": "slant"}, "depth_kind"),
        # Found by fuzzing: maps of its size took 20 s.
        ({"camera": CAMERA.section() | {"height": 10**6}}, "16 x 1000000 pixels is larger"),
        ({"camera": CAMERA.section() | {"height": 1}}, "needs 2 x 2 at least"),
        ({"error": ERROR | {"coefficients": {"distance": {"c0": 0.01}}}}, "lack 'c1'"),
        ({"effects": [{"name": "wigling"}]}, "Did you mean 'wiggling'"),
    ],
)
def test_a_file_of_no_sensor_is_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        sensor(**changes)
