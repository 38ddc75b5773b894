"""Whole recordings, their twins, and the truth beside them."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from optional import present
from simulation.small import IMPERFECT, expected_frames, files_in, planned, small

from tofcorr.data.recording import iterate_frames
from tofcorr.geometry.rays import ray_directions, z_depth_from_radial_distance
from tofcorr.options import resolve_options
from tofcorr.simulation.hooks import STAGES, Effect, FrameState
from tofcorr.simulation.options import SimulatorOptions
from tofcorr.simulation.signal import demodulate, distance_from_phase
from tofcorr.simulation.simulator import SensorPipeline, simulate


def test_the_same_options_give_the_same_bytes_those_in_truth_too(tmp_path: Path) -> None:
    simulate(small(sensor=IMPERFECT, seed=7, write_raw=True), tmp_path / "a")
    simulate(resolve_options(SimulatorOptions, tmp_path / "a/truth/options.yaml"), tmp_path / "b")
    simulate(small(sensor=IMPERFECT, seed=8, write_raw=True), tmp_path / "c")
    first, same, other = (files_in(tmp_path / name) for name in "abc")
    assert first == same
    assert all(first[name] != other[name] for name in ("depth.npy", "frames.csv", "raw.npy"))


def test_truth_is_kept_apart(tmp_path: Path) -> None:
    options = small(sensor=IMPERFECT, hand_eye={"guess": {"translation_mm": 30, "rotation_deg": 5}})
    guess = simulate(options, tmp_path / "r").tool_from_camera
    names = set(files_in(tmp_path / "r"))
    truth = {name for name in names if name.startswith("truth/")}
    assert names - truth == {"recording.yaml", "frames.csv", "depth.npy", "amplitude.npy"}
    beside = ("radial_distance.npy", "world_from_tool.npy", "truth.yaml", "options.yaml")
    assert truth == {f"truth/{name}" for name in beside}
    assert np.abs(guess - options.hand_eye.tool_from_camera().numpy()).max() > 1e-3
    true = np.load(tmp_path / "r/truth/radial_distance.npy")
    assert true.dtype == np.float32
    assert true.shape == (7, 12, 16)


def test_recorded_geometry_predicts_the_expected_measurement(tmp_path: Path) -> None:
    options = small(scene={"plane": {"normal": [0.0, 0.6, 0.8], "offset_m": 0.7}})
    recording = simulate(options, tmp_path / "r", noise=False)
    transform = options.hand_eye.tool_from_camera()
    for batch in iterate_frames(recording):
        points = ray_directions(recording.camera) * batch.radial_distance[..., None]
        in_tool = points @ transform[:3, :3].T + transform[:3, 3]
        height = torch.einsum("bhwk,bk->bhw", in_tool, batch.normal_tool)
        # Depth is stored as float32: 1e-7 of 2 m.
        assert (height + batch.offset_tool[:, None, None]).abs().max() < 5e-7


def test_z_depth_is_the_radial_distance_along_the_axis(tmp_path: Path) -> None:
    kinds = ("radial", "z")
    radial, z = (simulate(small(depth_kind=one), tmp_path / one, noise=False) for one in kinds)
    along = torch.from_numpy(np.array(radial.depth)).to(torch.float64)
    expected = z_depth_from_radial_distance(along, ray_directions(radial.camera))
    np.testing.assert_allclose(z.depth, expected, atol=3e-7)
    assert z.depth_kind == "z"


def test_raw_samples_demodulate_to_depth_and_amplitude(tmp_path: Path) -> None:
    recording = simulate(small(write_raw=True, sensor=IMPERFECT), tmp_path / "r")
    raw = np.array(recording.require("raw", "this test"))
    phase, amplitude, _ = demodulate(torch.from_numpy(raw).double())
    distance = distance_from_phase(phase, 20.0e6)
    np.testing.assert_allclose(recording.depth, distance, atol=1e-6)
    np.testing.assert_allclose(present(recording.amplitude), amplitude, rtol=1e-6)


def test_conditions_reach_the_recording_or_stay_unknown(tmp_path: Path) -> None:
    conditions = {"integration_time_us": [400.0], "ambient_counts": [30.0, 30.0]}
    conditions |= {"room_temperature_c": 20.0, "room_drift_c": 0.0, "body_rise_c": 10.0}
    conditions |= {"body_time_constant_s": 100.0, "power_on_s": 0.0}
    conditions |= {"interval_jitter": 0.0, "frame_interval_s": 50.0}
    recording = simulate(small(conditions=conditions), tmp_path / "all")
    np.testing.assert_allclose(recording.require("integration_time", "this test"), 400e-6)
    np.testing.assert_allclose(recording.require("ambient", "this test"), 30.0)
    np.testing.assert_allclose(recording.frames.timestamp, 50.0 * np.arange(7))
    warmed = 20.0 + 10.0 * (1 - np.exp(-0.5 * np.arange(7)))
    np.testing.assert_allclose(recording.require("body_temperature", "this test"), warmed)
    table = simulate(small(conditions=conditions | {"recorded": []}), tmp_path / "none").frames
    assert (table.pose_id, table.integration_time, table.ambient) == (None, None, None)


def _changed(stage: str, state: FrameState) -> dict[str, Any]:
    """Return what an effect changes at a stage, from what is ready by then."""
    if stage == "pose":
        assert state.radial_distance.numel() == 0
    changes: dict[str, Callable[[], dict[str, Any]]] = {
        "pose": lambda: {"offset": state.offset - 0.1},
        "light": lambda: {"amplitude": 0.5 * state.amplitude},
        "delay": lambda: {"delay": state.delay + 0.02},
        "signal": lambda: {
            "signal": state.signal * state.path_phasor(0.03),
            "tap_delay": torch.full((4, 12, 16), 0.04, dtype=torch.float64),
        },
        "taps": lambda: {"taps": state.taps + 1000.0},
        "readout": lambda: {"measured_distance": state.measured_distance + 0.05},
    }
    return changes.get(stage, dict)()


def test_effects_act_in_every_stage_in_order() -> None:
    exact = {"repeatability_mm": 0.0, "repeatability_mrad": 0.0}
    options = small(robot=exact, shots=[{"target": "white", "poses": 1}])
    (plain,), effect, calls = expected_frames(options), Effect(), []
    for stage in STAGES:

        def act(state: FrameState, stage: str = stage) -> None:
            calls.append(stage)
            vars(state).update(_changed(stage, state))

        setattr(effect, f"on_{stage}", act)
    pipeline = SensorPipeline(plain.camera, options.sensor, options.scene, (effect,))
    state = pipeline.run(planned(options)[0])
    assert calls == list(STAGES)
    error = state.measured_distance - state.radial_distance
    torch.testing.assert_close(error, torch.full_like(error, 0.02 + 0.03 + 0.04 + 0.05))
    # The wall came nearer by 0.1 m, and of the light that this gives half arrived.
    gained = (plain.radial_distance / state.radial_distance) ** 2
    torch.testing.assert_close(state.measured_amplitude, 0.5 * gained * plain.measured_amplitude)


def test_measurement_is_differentiable_in_what_effects_change() -> None:
    options = small(shots=[{"target": "white", "poses": 1}])
    by = torch.zeros((), dtype=torch.float64, requires_grad=True)

    class Later(Effect):
        def on_delay(self, state: FrameState) -> None:
            state.delay = state.delay + by * state.radial_distance

    (plain,) = expected_frames(options)
    state = SensorPipeline(plain.camera, options.sensor, options.scene, (Later(),)).run(plain)
    (gradient,) = torch.autograd.grad(state.measured_distance.sum(), by)
    torch.testing.assert_close(gradient, state.radial_distance.sum())
