"""A simulator may come as options, as frames of any program, or as a function: one answer.

What it says of its own error, hand-eye transform and parameters counts.
"""

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from cameras import rigid
from diagnosed_recordings import recorded, simulator
from optional import present
from scipy.spatial.transform import Rotation

from tofcorr.data.recording import Recording
from tofcorr.data.writing import write_recording
from tofcorr.diagnosis.diagnose import diagnose, prepare
from tofcorr.diagnosis.given import (
    frames_of,
    open_simulator,
    refuse_mistaken_geometry,
    rendered_error,
    simulated_error,
)
from tofcorr.diagnosis.options import DiagnosisOptions
from tofcorr.diagnosis.sums.observations import Observations, observe, predicted_distance
from tofcorr.errors import CalibrationDataError, ConfigError
from tofcorr.geometry.rays import ray_directions
from tofcorr.simulation.options import SimulatorOptions
from tofcorr.simulation.simulator import twin_frames

# One candidate effect is enough for laws about the simulator.
OPTIONS = DiagnosisOptions(
    bootstraps=40, simulate_anew=False, page=False, catalogue=("integration_time",)
)
# Where no camera of these recordings sits on the tool.
MOUNT = rigid(Rotation.identity(), [0.0, 0.2, 0.1])
# Rounding of depth to float32 at two metres.
ROUNDING = 3e-7
Render = Callable[..., Recording]


Images = dict[str, np.ndarray]
"""Depth and amplitude that another simulator renders at the poses of a recording."""


@pytest.fixture(scope="module")
def options() -> SimulatorOptions:
    """The camera of `nothing_missing`, its effects and errors included."""
    return simulator(31)


@pytest.fixture(scope="module")
def frames(nothing_missing: Recording, options: SimulatorOptions) -> Images:
    states = list(twin_frames(options, nothing_missing, reflectivity="from_recording"))
    taken = {"depth": "measured_distance", "amplitude": "measured_amplitude"}
    return {
        name: torch.stack([getattr(state, own) for state in states]).float().numpy()
        for name, own in taken.items()
    }


@pytest.fixture(scope="module")
def observations(nothing_missing: Recording) -> Observations:
    return observe(nothing_missing, OPTIONS.most_pixels)


@pytest.fixture
def rendered(
    nothing_missing: Recording, options: SimulatorOptions, frames: Images, tmp_path: Path
) -> Render:
    """Write frames with the rows of a recording; `order` says which row each frame has."""
    every, pose = np.arange(nothing_missing.num_frames), options.hand_eye.tool_from_camera().numpy()

    def written(name: str = "sim", order: np.ndarray = every, **changes: Any) -> Recording:
        parts: dict[str, Any] = frames | {
            "camera": nothing_missing.camera,
            "depth_kind": nothing_missing.depth_kind,
            "rows": nothing_missing.frames.select(order),
            "modulation_frequency": nothing_missing.modulation_frequency,
            "tool_from_camera": pose,
        }
        write_recording(tmp_path / name, **parts | changes)
        return Recording.open(tmp_path / name)

    return written


def test_rendered_frames_of_the_built_in_simulator_are_the_simulator_itself(
    nothing_missing: Recording, options: SimulatorOptions, rendered: Render
) -> None:
    one = prepare(nothing_missing, OPTIONS, options)
    other = prepare(nothing_missing, OPTIONS, rendered())
    assert torch.allclose(present(one.as_given), present(other.as_given), atol=ROUNDING)
    # The noise of rendered frames is estimated, so that weights differ by a trace.
    assert torch.allclose(one.study.fit.residual, other.study.fit.residual, atol=1e-4)


def test_order_and_number_of_renders_do_not_matter(
    frames: Images, observations: Observations, rendered: Render
) -> None:
    mixed = np.random.default_rng(3).permutation(len(frames["depth"]))
    order = np.concatenate([mixed, mixed[::-1]])
    both = {name: images[order] for name, images in frames.items()}
    plain = rendered_error(rendered(), observations, OPTIONS)
    again = rendered_error(rendered("twice", order, **both), observations, OPTIONS)
    assert torch.allclose(plain.error, again.error, atol=ROUNDING, equal_nan=True)
    assert not plain.limits


def test_a_function_gives_what_its_frames_give(
    options: SimulatorOptions, frames: Images, observations: Observations, rendered: Render
) -> None:
    pose = options.hand_eye.tool_from_camera().numpy()
    returned = {"depth": frames["depth"], "tool_from_camera": pose}
    function = present(open_simulator(lambda _: returned, observations.recording))
    ours = simulated_error(function, observations, OPTIONS)
    theirs = rendered_error(rendered(), observations, OPTIONS)
    assert torch.allclose(ours.error, theirs.error, atol=ROUNDING, equal_nan=True)


def test_the_mean_of_several_renders_has_less_noise(
    frames: Images, observations: Observations, rendered: Render
) -> None:
    times, sd = 4, 2e-3
    order = np.tile(np.arange(len(frames["depth"])), times)
    again = {name: images[order] for name, images in frames.items()}
    again["depth"] += np.random.default_rng(4).normal(0, sd, again["depth"].shape)
    simulated = rendered_error(rendered(order=order, **again), observations, OPTIONS)
    sigma = float(simulated.sigma.square().mean().sqrt())
    assert sigma == pytest.approx(sd / times**0.5, rel=0.05)


def test_the_noise_of_dark_pixels_of_camera_and_renders_is_that_of_their_difference(
    nothing_missing: Recording, frames: Images, rendered: Render
) -> None:
    """Renders of read noise, A^-2 below a brightness and constant above: no law goes on so."""
    depth, light = frames["depth"], frames["amplitude"]
    sd = 3e-3 * np.clip(np.nanmedian(light) / np.maximum(light, 1.0), 1.0, 2.0)
    noisy = rendered(depth=depth + sd * np.random.default_rng(6).standard_normal(depth.shape))
    study = prepare(nothing_missing, OPTIONS, noisy).study
    fit, amplitude = study.fit, present(study.inputs.amplitude)
    darkest = amplitude < amplitude.quantile(0.05)
    seen = fit.residual[darkest].square().mean().sqrt()
    assert float(fit.sigma[darkest].square().mean().sqrt()) == pytest.approx(float(seen), rel=0.1)


def test_a_pixel_that_the_simulator_does_not_see_is_left_out(
    nothing_missing: Recording, frames: Images, rendered: Render
) -> None:
    depth = frames["depth"].copy()
    depth[:, :6] = np.nan
    prepared = prepare(nothing_missing, OPTIONS, rendered(depth=depth))
    rows = prepared.study.observations.pixel // nothing_missing.camera.width
    assert int(rows.min()) == 6
    assert any("left out" in warning for warning in prepared.warnings)


@pytest.mark.slow
def test_other_cameras_and_depths_are_refused_in_a_sentence(
    nothing_missing: Recording, frames: Images, observations: Observations, rendered: Render
) -> None:
    camera, depth, bright = nothing_missing.camera, frames["depth"], frames["amplitude"]
    matrix = np.array(camera.matrix)
    matrix[0, 0] += 1.0
    other = replace(camera, matrix=tuple(map(tuple, matrix.tolist())))
    smaller = replace(camera, height=camera.height - 1)
    cut = {"depth": depth[:, 1:], "amplitude": bright[:, 1:]}
    cases: dict[str, dict[str, Any]] = {
        "pixels look up to": {"camera": other},
        "32 x 23 pixels": {"camera": smaller, **cut},
        "write depth_kind: radial": {"depth_kind": "z"},
        "depth or poses are in another unit": {"depth": 1e3 * depth},
        # Both were diagnosed: flipped frames as "0.0 mm, no more than the noise".
        "if one mistake is undone": {"depth": depth[:, ::-1], "amplitude": bright[:, ::-1]},
        "degrees from its tool_from_camera": {"tool_from_camera": MOUNT},
    }
    for words, changes in cases.items():
        with pytest.raises(CalibrationDataError, match=words) as refusal:
            rendered_error(rendered(words, **changes), observations, OPTIONS)
        assert str(refusal.value).count(". ") == 0


@pytest.mark.parametrize(
    "added",  # Pixels of the principal point in x and y, and per cent of the focal lengths.
    [
        (0.0, 0.0, 0.0, 0.0),
        (0.5, 0.5, 0.0, 0.0),
        (0.5, -0.5, 0.0, 0.0),
        (0.0, 1.0, 0.0, 0.0),
        (0.0, 0.0, 2.0, 2.0),
        (0.0, 0.0, 3.0, 0.0),
        (-0.4, 0.0, 0.0, -3.0),
    ],
)
def test_pixels_that_look_beside_where_the_camera_matrix_says_are_named_with_size(
    added: tuple[float, ...],
    observations: Observations,
    options: SimulatorOptions,
    rendered: Render,
) -> None:
    """Frames of another renderer, 5 to 9 mm off by its pixel centres, had nothing odd."""
    recording = observations.recording
    matrix = np.array(recording.camera.matrix)
    matrix[:2] += np.c_[matrix[:2, :2] * added[2:] / 100, added[:2]]
    camera = replace(recording.camera, matrix=tuple(map(tuple, matrix.tolist())))
    rays = ray_directions(camera).numpy()
    poses = recording.frames.world_from_tool @ options.hand_eye.tool_from_camera().numpy()
    walls = zip(poses, recording.frames.normal_world, recording.frames.offset, strict=True)
    depth = [-(n @ pose[:3, 3] + d) / (rays @ pose[:3, :3].T @ n) for pose, n, d in walls]
    noise = np.random.default_rng(1).normal(scale=0.002, size=np.shape(depth))
    frames = rendered(depth=(np.array(depth) + noise).astype(np.float32))
    limits = " ".join(rendered_error(frames, observations, OPTIONS).limits)
    numbers = map(float, re.findall(r"([+-][0-9.]+)(?: px|%)", limits))
    assert [*numbers] == pytest.approx([one for one in added if one], rel=0.05)


def test_what_a_function_returned_is_refused_by_what_it_is(nothing_missing: Recording) -> None:
    """A pose was refused as "recording.yaml: ...", and arrays by the name of a scratch folder."""
    depth = np.ones(nothing_missing.depth.shape)
    poses = np.diag([1.0, 1.0, -1.0, 1.0]), np.full((4, 4), np.nan)
    of_pose = "The simulator's tool_from_camera: "
    cases: list[tuple[str, Any]] = [
        ("The simulator's depth must be numbers of the shape", depth[:-1]),
        (r".*Use tensor\.detach\(\)", torch.ones(depth.shape, requires_grad=True)),
        (
            "the frames that the function returned/amplitude.npy: frame 0, row 0",
            {"depth": depth, "amplitude": -depth},
        ),
        *((of_pose, {"depth": depth, "tool_from_camera": pose}) for pose in poses),
    ]
    for words, returned in cases:
        with pytest.raises(CalibrationDataError, match=f"^{words}"):
            frames_of(returned, nothing_missing)


@pytest.mark.parametrize("sim", [None, np.ones(3)])
def test_what_is_no_simulator_is_refused(
    sim: Any, nothing_missing: Recording, tmp_path: Path
) -> None:
    words = r"recording\.yaml" if sim is None else r"got ndarray\. Frames in memory are handed"
    with pytest.raises(CalibrationDataError if sim is None else ConfigError, match=words):
        open_simulator(tmp_path if sim is None else sim, nothing_missing)


@pytest.mark.parametrize("guess", [None, {"translation_mm": 3.0, "rotation_deg": 0.0}])
def test_a_recording_of_the_built_in_simulator_is_one_once_its_guess_is_exact(
    guess: dict[str, float] | None, tmp_path: Path
) -> None:
    """A guess 3 mm off was taken as exact, and the gap was called the mounting of the camera."""
    few = {"shots": [{"target": "white", "poses": 20}]}
    changes = few if guess is None else few | {"hand_eye": {"guess": guess}}
    guessed = recorded(tmp_path / "guess", 5, changes=changes)
    with pytest.raises(CalibrationDataError, match=r"--set hand_eye\.guess\.translation_mm=0"):
        refuse_mistaken_geometry(guessed)
    true = simulator(5, changes=changes).hand_eye.tool_from_camera()
    refuse_mistaken_geometry(replace(guessed, tool_from_camera=true.numpy()))
    exact = few | {"hand_eye": {"guess": {"translation_mm": 0.0, "rotation_deg": 0.0}}}
    refuse_mistaken_geometry(recorded(tmp_path / "exact", 5, changes=exact))


def test_a_fixed_hand_eye_transform_is_that_of_the_simulator(
    nothing_missing: Recording, options: SimulatorOptions
) -> None:
    # It was the recording's guess, which the simulator does not share.
    fixed = OPTIONS.model_copy(update={"hand_eye": "fixed"})
    prepared = prepare(nothing_missing, fixed, options)
    assert torch.equal(prepared.study.fit.tool_from_camera, options.hand_eye.tool_from_camera())
    assert float(prepared.study.fit.residual.abs().median()) < 5e-3


def test_the_gap_as_given_is_that_of_the_simulators_own_parameters(
    nothing_missing: Recording, options: SimulatorOptions, observations: Observations
) -> None:
    """An ideal simulator with the true hand-eye transform: all errors of the camera are the gap."""
    without = options.sensor.model_copy(update={"delays": type(options.sensor.delays)()})
    ideal = options.model_copy(update={"sensor": without})
    found = diagnose(nothing_missing, ideal, OPTIONS)
    error = simulated_error(options, observations, OPTIONS).error
    truth = float(error.square().mean().sqrt())
    as_given = present(found.gap.as_given)
    assert truth > 0.01
    assert as_given == pytest.approx(truth, rel=0.05)
    assert found.gap.before < 0.1 * truth
    assert f"{as_given * 1e3:.1f} mm" in ".".join(found.verdict.split(".")[:2])
    shares = {share.cause: share.share for share in found.shares}
    assert sum(shares.values()) == pytest.approx(1.0, abs=1e-9)
    assert abs(shares["hand_eye"]) < 0.05


def test_what_a_simulator_does_elsewhere_is_carried_to_the_recording(
    nothing_missing: Recording,
    options: SimulatorOptions,
    observations: Observations,
    tmp_path: Path,
) -> None:
    """The simulator saw 50 other poses; its error at the recording's own is known from options."""
    elsewhere = recorded(tmp_path / "sim", 931, noise=False)
    exact = options.hand_eye.tool_from_camera().numpy()
    simulated = rendered_error(replace(elsewhere, tool_from_camera=exact), observations, OPTIONS)
    truth = simulated_error(options, observations, OPTIONS).error
    known = simulated.error.isfinite()
    assert float(known.double().mean()) > 0.9
    off = (simulated.error - truth)[known]
    assert float(off.square().mean().sqrt()) < 3e-4
    assert "other poses" in simulated.limits[0]
    assert simulated.carried


def test_the_truth_of_rendered_frames_is_their_own_plane(observations: Observations) -> None:
    """An error is simulated less true distance, whatever the hand-eye transform."""
    pose = torch.from_numpy(observations.recording.tool_from_camera)
    camera = observations.recording.camera
    size = camera.height * camera.width
    truth = torch.zeros(observations.num_frames, size, dtype=torch.float64)
    truth[observations.frame, observations.pixel] = predicted_distance(observations, pose)
    depth = (truth + 0.004).reshape(-1, camera.height, camera.width).numpy()
    error = rendered_error(frames_of(depth, observations.recording), observations, OPTIONS).error
    assert torch.allclose(error, torch.full_like(error, 0.004), atol=ROUNDING)
