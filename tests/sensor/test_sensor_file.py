"""`sensor.yaml`: what is written is read, and what breaks the format is refused."""

from pathlib import Path
from typing import Any

import pytest
import torch
from sensor.sensors import ERROR, NOISE, plane_scene, sensor_file, sensor_values
from sensor.test_forward import CONDITIONS, EFFECTS

from tofcorr.errors import ConfigError, ExportError, StateError
from tofcorr.sensor.model import SensorModel
from tofcorr.sensor.sensor_file import SensorFile

ALL = [{"name": name, **EFFECTS[name]} for name in EFFECTS]


def test_a_saved_model_measures_what_it_did(tmp_path: Path) -> None:
    given = sensor_file(
        error=ERROR | {"reads": "measured_distance"},
        effects=ALL,
        noise=NOISE | {"fixed_share": 0.3, "correlation_px": 0.7},
        dropouts={"base_share": 0.1, "amplitude_at_half": 700.0, "saturation_amplitude": 900.0},
        light={"amplitude_at_1m": 2000.0},
        title="A camera\nof tests.",
        measured_from=["Twelve images."],
    )
    model = SensorModel(given, torch.float64)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(0.002 * torch.rand(parameter.shape, dtype=torch.float64))
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
    model = SensorModel(sensor_file(error=ERROR))
    same, other = SensorModel(sensor_file(error=ERROR)), SensorModel(sensor_file(effects=ALL))
    same.load_state_dict(model.state_dict())
    with pytest.raises(StateError, match="the state is of another model"):
        other.load_state_dict(model.state_dict(), strict=False)
    farther = sensor_values(error=ERROR)
    farther["validity"] = farther["validity"] | {"radial_distance_m": [0.4, 9.0]}
    with pytest.raises(StateError, match="validity"):
        SensorModel(SensorFile.from_mapping(farther, "the test")).load_state_dict(
            model.state_dict()
        )


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"version": 2}, "version"),
        ({"format": "tofcorr-calibration"}, "format"),
        ({"nosie": {}}, "Did you mean 'noise'"),
        ({"noise": {"floor_m": -0.1}}, "floor_m"),
        ({"dropouts": {"base_share": 1.4}}, "base_share"),
        ({"validity": {"radial_distance_m": [0.5]}}, "radial_distance_m"),
        ({"depth_kind": "slant"}, "depth_kind"),
    ],
)
def test_a_file_that_breaks_the_format_is_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        sensor_file(**changes)


def test_a_camera_of_more_pixels_than_any_is_refused_before_maps_of_its_size_are_made() -> None:
    # Found by fuzzing: an image of 12 x 1,000,000 pixels took 20 s.
    values = sensor_values()
    values["camera"] = values["camera"] | {"width": 12, "height": 1_000_000}
    with pytest.raises(ConfigError, match="12 x 1000000 pixels is larger than any"):
        SensorFile.from_mapping(values, "the test")


def test_a_camera_of_a_single_row_is_refused() -> None:
    values = sensor_values()
    values["camera"] = values["camera"] | {"height": 1}
    with pytest.raises(ConfigError, match="needs 2 x 2 at least"):
        SensorModel(SensorFile.from_mapping(values, "the test"))


def test_missing_coefficients_and_unknown_effects_are_refused() -> None:
    lacking = ERROR | {"coefficients": {"distance": {"c0": 0.01}}}
    with pytest.raises(ConfigError, match="lack 'c1'"):
        SensorModel(sensor_file(error=lacking))
    with pytest.raises(ConfigError, match="Did you mean 'wiggling'"):
        SensorModel(sensor_file(effects=[{"name": "wigling"}]))


def test_a_file_that_cannot_be_written_is_refused_and_leaves_nothing(tmp_path: Path) -> None:
    model = SensorModel(sensor_file(error=ERROR))
    with pytest.raises(ExportError, match="folder does not exist"):
        model.save(tmp_path / "nowhere" / "sensor.yaml")
    assert list(tmp_path.iterdir()) == []
