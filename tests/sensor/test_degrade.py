"""`tofcorr degrade`: an ideal recording becomes one of the real camera, whole or not at all."""

import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from running import Program
from sensor.sensors import sensor_file
from small_recordings import CAMERA, frame_rows, small_images

from tofcorr.data.recording import Recording
from tofcorr.data.writing import write_recording
from tofcorr.errors import CalibrationDataError
from tofcorr.sensor.degrade import degrade
from tofcorr.sensor.model import SensorModel
from tofcorr.sensor.sensor_file import SensorFile

OWN = {
    "camera": CAMERA.section(),
    "depth_kind": "z",
    "modulation_frequency_hz": None,
    "error": {"coefficients": {"distance": {"c0": 0.02}}},
    "effects": [{"name": "warm_up", "heat_120s": 0.05}, {"name": "pixel", "x1_y0": 0.004}],
    "noise": {"floor_m": 0.002, "correlation_px": 0.5},
    "dropouts": {"base_share": 0.2},
    "validity": {"radial_distance_m": [0.4, 3.0]},
}


def sensor(**changes: object) -> SensorFile:
    return sensor_file(**OWN | changes)


@pytest.fixture
def ideal(tmp_path: Path) -> Recording:
    generator = np.random.default_rng(3)
    images = small_images(generator)
    del images["raw"]
    rows, folder = frame_rows(generator), tmp_path / "ideal"
    write_recording(folder, camera=CAMERA, depth_kind="radial", rows=rows, **images)
    return Recording.open(folder)


def test_all_but_images_stays_and_ideal_depth_is_kept(ideal: Recording, tmp_path: Path) -> None:
    done = degrade(sensor(depth_kind="radial"), ideal, tmp_path / "real", seed=4)
    found = done.recording
    csv = [(each.path / "frames.csv").read_bytes() for each in (ideal, found)]
    assert csv[0] == csv[1]
    np.testing.assert_array_equal(found.require("true_depth", "this test"), ideal.depth)
    there = np.isfinite(ideal.depth) & (ideal.depth > 0)
    lit, light = (each.require("amplitude", "this test") for each in (found, ideal))
    np.testing.assert_array_equal(lit, np.where(there, light, 0.0))
    returned = np.isfinite(found.depth)
    assert not returned[~there].any()
    assert done.valid_share == pytest.approx(returned.sum() / there.sum())
    assert 0.7 < done.valid_share < 0.9
    # Degraded once more, it is the ideal depth that is degraded, not the degraded one.
    again = degrade(sensor(depth_kind="radial"), found, tmp_path / "again", seed=4).recording
    np.testing.assert_array_equal(again.depth, found.depth)


def test_each_frame_is_what_the_model_measures_of_it(ideal: Recording, tmp_path: Path) -> None:
    """Radial depth of a simulator becomes z depth of the camera; a warm-up remembers frames."""
    quiet = sensor(noise=None, dropouts=None)
    found = degrade(quiet, ideal, tmp_path / "real").recording
    assert found.depth_kind == "z"
    model = SensorModel(quiet)
    depth = torch.from_numpy(np.array(ideal.depth)) * model.eye.ray_directions[..., 2]
    times = torch.from_numpy(ideal.frames.timestamp)
    with torch.no_grad():
        wanted = model(depth, timestamp_s=times).depth
        alone = model(depth[5], timestamp_s=float(times[5])).depth
    np.testing.assert_allclose(found.depth, wanted, rtol=0, atol=1e-6)
    assert float((alone - wanted[5]).abs().nan_to_num(0.0).max()) > 1e-4


def test_the_command_writes_a_recording_and_names_what_it_left_out(
    ideal: Recording, tmp_path: Path, program: Program
) -> None:
    file = tmp_path / "sensor.yaml"
    effects = [{"name": "multipath", "below_near": 0.2}]
    file.write_text(yaml.safe_dump(sensor(effects=effects).to_mapping()), encoding="utf-8")
    words = ("--sensor", file, "--recording", ideal.path, "--out", tmp_path / "real")
    code, out, told = program("degrade", *words)
    assert code == 0
    assert "6 frames; " in out
    assert "Warning: Left out: multipath: it belongs to the target and the room" in told


def test_another_camera_is_refused_and_a_lens_warned_of(ideal: Recording, tmp_path: Path) -> None:
    with pytest.raises(CalibrationDataError, match="frames are 7x5 pixels, the sensor has 512x424"):
        degrade("kinect_v2", ideal, tmp_path / "real")
    camera = sensor().camera.to_mapping() | {"distortion": []}
    with pytest.warns(UserWarning, match="intrinsics are not the sensor.s"):
        degrade(sensor(camera=camera), ideal, tmp_path / "real")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["ideal", "real"]


def test_frames_of_another_hand_eye_transform_are_named(ideal: Recording, tmp_path: Path) -> None:
    """Its errors and its hand-eye transform were found together."""
    other = np.array(ideal.tool_from_camera)
    other[0, 3] += 0.02
    # A quarter turn about the optical axis: no identity, which would say nothing.
    turned = np.array([[0.0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    mounted = replace(ideal, tool_from_camera=ideal.tool_from_camera @ turned)
    for number, found in enumerate((other, ideal.tool_from_camera)):
        own = sensor(tool_from_camera=(found @ turned).tolist(), depth_kind="radial")
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            degrade(own, mounted, tmp_path / str(number))
        said = [str(one.message) for one in caught if "tool_from_camera" in str(one.message)]
        assert len(said) == 1 - number
        assert all("20.0 mm and 0.00 degrees" in sentence for sentence in said)


def rendered(folder: Path, depth: float, amplitude: float) -> Recording:
    """Write even frames of a simulator."""
    rows = frame_rows(np.random.default_rng(4))
    shape = (len(rows), CAMERA.height, CAMERA.width)
    depths, lights = (np.full(shape, value, np.float32) for value in (depth, amplitude))
    images: dict[str, Any] = {"depth": depths, "amplitude": lights}
    write_recording(folder, camera=CAMERA, depth_kind="z", rows=rows, **images)
    return Recording.open(folder)


def test_depth_in_millimetres_is_said(tmp_path: Path) -> None:
    # It was degraded without a word: "100.0 % of the pixels are valid".
    metres = rendered(tmp_path / "metres", 1.2, 100.0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        done = degrade(sensor(effects=[]), metres, tmp_path / "good")
    assert done.covered_share == 1.0
    millimetres = rendered(tmp_path / "millimetres", 1200.0, 100.0)
    with pytest.warns(UserWarning, match=r"0 % .* 0\.4 to 3 m; .* Is the depth in metres\?"):
        done = degrade(sensor(effects=[]), millimetres, tmp_path / "far")
    assert done.covered_share == 0.0


def test_a_reflectivity_of_8_bits_is_refused(tmp_path: Path) -> None:
    ideal = rendered(tmp_path / "ideal", 1.2, 200.0)
    with pytest.raises(CalibrationDataError, match=r"a share from 0 to 1, got 200; divide"):
        degrade(sensor(), ideal, tmp_path / "out", amplitude_is="reflectivity")
    assert not (tmp_path / "out").exists()


def test_the_folder_of_a_report_stands_for_its_sensor(tmp_path: Path) -> None:
    report = tmp_path / "report"
    report.mkdir()
    SensorModel(sensor()).save(report / "sensor.yaml")
    assert SensorModel.load(report).sensor == SensorModel.load(report / "sensor.yaml").sensor
