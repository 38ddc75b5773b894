"""A simulator may come as options, as frames of any program, or as a function: one answer."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import diagnosed_recordings
import numpy as np
import pytest
import torch

from tofcorr.data.recording import Recording
from tofcorr.data.writing import write_recording
from tofcorr.diagnosis.given.checks import refuse_mistaken_geometry
from tofcorr.diagnosis.given.rendered import PythonSimulator, RenderedSimulator
from tofcorr.diagnosis.given.source import BuiltInSimulator, open_simulator
from tofcorr.diagnosis.options import DiagnosisOptions
from tofcorr.diagnosis.prepare import prepare
from tofcorr.diagnosis.sums.base_fit import SimulatorError
from tofcorr.diagnosis.sums.observations import Observations, observe
from tofcorr.errors import CalibrationDataError, ConfigError
from tofcorr.simulation.options import SimulatorOptions
from tofcorr.simulation.simulator import twin_frames

# One candidate effect is enough for laws about the simulator.
OPTIONS = DiagnosisOptions(
    bootstraps=40, simulate_anew=False, page=False, catalogue=("integration_time",)
)
# Where no camera of these recordings sits on the tool.
MOUNT = np.eye(4)
MOUNT[:3, 3] = 0.0, 0.2, 0.1
# Rounding of depth to float32 at two metres.
ROUNDING = 3e-7


@dataclass(frozen=True)
class Frames:
    """What another simulator renders at the poses of a recording."""

    depth: np.ndarray
    amplitude: np.ndarray


@pytest.fixture(scope="module")
def options() -> SimulatorOptions:
    """The camera of `nothing_missing`, its effects and errors included."""
    return diagnosed_recordings.options(31)


@pytest.fixture(scope="module")
def frames(nothing_missing: Recording, options: SimulatorOptions) -> Frames:
    states = list(twin_frames(options, nothing_missing, reflectivity="from_recording"))
    return Frames(
        np.stack([state.measured_distance.numpy() for state in states]).astype(np.float32),
        np.stack([state.measured_amplitude.numpy() for state in states]).astype(np.float32),
    )


@pytest.fixture(scope="module")
def observations(nothing_missing: Recording) -> Observations:
    return observe(nothing_missing, OPTIONS.most_pixels)


def _written(
    folder: Path,
    recording: Recording,
    options: SimulatorOptions,
    frames: Frames,
    order: np.ndarray | None = None,
    **changes: Any,
) -> Recording:
    """Write frames with the rows of a recording; `order` says which row each frame has."""
    order = np.arange(recording.num_frames) if order is None else order
    parts: dict[str, Any] = {
        "camera": recording.camera,
        "depth_kind": recording.depth_kind,
        "rows": recording.frames.select(order),
        "depth": frames.depth,
        "amplitude": frames.amplitude,
        "modulation_frequency": recording.modulation_frequency,
        "tool_from_camera": options.hand_eye.tool_from_camera().numpy(),
    }
    write_recording(folder, **parts | changes)
    return Recording.open(folder)


def test_rendered_frames_of_the_built_in_simulator_are_the_simulator_itself(
    nothing_missing: Recording,
    options: SimulatorOptions,
    frames: Frames,
    tmp_path: Path,
) -> None:
    rendered = RenderedSimulator(_written(tmp_path / "sim", nothing_missing, options, frames))
    one = prepare(nothing_missing, OPTIONS, BuiltInSimulator(options))
    other = prepare(nothing_missing, OPTIONS, rendered)
    assert one.as_given is not None
    assert other.as_given is not None
    assert torch.allclose(one.as_given, other.as_given, atol=ROUNDING)
    # The noise of rendered frames is estimated, so that weights differ by a trace.
    assert torch.allclose(one.study.fit.residual, other.study.fit.residual, atol=1e-4)


def _error(simulated: SimulatorError) -> torch.Tensor:
    return simulated.error


def test_order_and_number_of_renders_do_not_matter(
    nothing_missing: Recording,
    options: SimulatorOptions,
    frames: Frames,
    observations: Observations,
    tmp_path: Path,
) -> None:
    count = nothing_missing.num_frames
    mixed = torch.randperm(count, generator=torch.Generator().manual_seed(3)).numpy()
    once = _written(tmp_path / "once", nothing_missing, options, frames)
    order = np.concatenate([mixed, mixed[::-1]])
    both = Frames(frames.depth[order], frames.amplitude[order])
    twice = _written(tmp_path / "twice", nothing_missing, options, both, order)
    plain = RenderedSimulator(once).simulate(observations, OPTIONS)
    again = RenderedSimulator(twice).simulate(observations, OPTIONS)
    assert torch.allclose(_error(plain), _error(again), atol=ROUNDING, equal_nan=True)
    assert not plain.limits


def test_a_function_gives_what_its_frames_give(
    nothing_missing: Recording,
    options: SimulatorOptions,
    frames: Frames,
    observations: Observations,
    tmp_path: Path,
) -> None:
    written = _written(tmp_path / "sim", nothing_missing, options, frames)
    pose = options.hand_eye.tool_from_camera().numpy()
    function = PythonSimulator(lambda _: {"depth": frames.depth, "tool_from_camera": pose})
    ours = _error(function.simulate(observations, OPTIONS))
    theirs = _error(RenderedSimulator(written).simulate(observations, OPTIONS))
    assert torch.allclose(ours, theirs, atol=ROUNDING, equal_nan=True)


def test_the_mean_of_several_renders_has_less_noise(
    nothing_missing: Recording,
    options: SimulatorOptions,
    frames: Frames,
    observations: Observations,
    tmp_path: Path,
) -> None:
    generator = np.random.default_rng(4)
    count, times, sd = nothing_missing.num_frames, 4, 2e-3
    noisy = Frames(
        np.tile(frames.depth, (times, 1, 1))
        + generator.normal(0, sd, (times * count, *frames.depth.shape[1:])).astype(np.float32),
        np.tile(frames.amplitude, (times, 1, 1)),
    )
    order = np.tile(np.arange(count), times)
    written = _written(tmp_path / "sim", nothing_missing, options, noisy, order)
    simulated = RenderedSimulator(written).simulate(observations, OPTIONS)
    sigma = float(simulated.sigma.square().mean().sqrt())
    assert sigma == pytest.approx(sd / times**0.5, rel=0.05)


def test_the_noise_of_dark_pixels_of_camera_and_renders_is_that_of_their_difference(
    nothing_missing: Recording, options: SimulatorOptions, frames: Frames, tmp_path: Path
) -> None:
    """Renders of read noise, A^-2 below a brightness and constant above: no law goes on so."""
    generator = np.random.default_rng(6)
    bright = np.nanmedian(frames.amplitude)
    sd = 3e-3 * np.clip(bright / np.maximum(frames.amplitude, 1.0), 1.0, 2.0)
    drawn = generator.standard_normal(frames.depth.shape) * sd
    noisy = Frames(frames.depth + drawn.astype(np.float32), frames.amplitude)
    rendered = RenderedSimulator(_written(tmp_path / "sim", nothing_missing, options, noisy))
    study = prepare(nothing_missing, OPTIONS, rendered).study
    fit, amplitude = study.fit, study.inputs.amplitude
    assert amplitude is not None
    darkest = amplitude < amplitude.quantile(0.05)
    seen = fit.residual[darkest].square().mean().sqrt()
    assert float(fit.sigma[darkest].square().mean().sqrt()) == pytest.approx(float(seen), rel=0.1)


def test_a_pixel_that_the_simulator_does_not_see_is_left_out(
    nothing_missing: Recording, options: SimulatorOptions, frames: Frames, tmp_path: Path
) -> None:
    depth = frames.depth.copy()
    depth[:, :6] = np.nan
    holes = _written(tmp_path / "sim", nothing_missing, options, replace(frames, depth=depth))
    prepared = prepare(nothing_missing, OPTIONS, RenderedSimulator(holes))
    rows = prepared.study.observations.pixel // nothing_missing.camera.width
    assert int(rows.min()) == 6
    assert any("left out" in warning for warning in prepared.warnings)


def test_other_cameras_depths_and_shapes_are_refused_in_a_sentence(
    nothing_missing: Recording,
    options: SimulatorOptions,
    frames: Frames,
    observations: Observations,
    tmp_path: Path,
) -> None:
    matrix = np.array(nothing_missing.camera.matrix)
    matrix[0, 0] += 1.0
    other = replace(nothing_missing.camera, matrix=tuple(map(tuple, matrix.tolist())))
    cropped = Frames(frames.depth[:, 1:], frames.amplitude[:, 1:])
    smaller = replace(nothing_missing.camera, height=nothing_missing.camera.height - 1)
    cases: list[tuple[str, Callable[[], object]]] = []

    def rendered(name: str, own: Frames = frames, **changes: Any) -> Callable[[], object]:
        written = _written(tmp_path / name, nothing_missing, options, own, **changes)
        return lambda: RenderedSimulator(written).simulate(observations, OPTIONS)

    cases.append(("pixels look up to", rendered("lens", camera=other)))
    cases.append(("32 x 23 pixels", rendered("size", cropped, camera=smaller)))
    cases.append(("depth_kind radial", rendered("kind", depth_kind="z")))
    cases.append(("unit of depth", rendered("unit", Frames(1e3 * frames.depth, frames.amplitude))))
    # Both were diagnosed: flipped frames as "0.0 mm, no more than the noise".
    flipped = Frames(frames.depth[:, ::-1], frames.amplitude[:, ::-1])
    cases.append(("if one mistake is undone", rendered("flipped", flipped)))
    cases.append(("degrees from its tool_from_camera", rendered("mount", tool_from_camera=MOUNT)))
    wrong = PythonSimulator(lambda _: frames.depth[:-1])
    cases.append(("recording's shape", lambda: wrong.simulate(observations, OPTIONS)))
    for words, simulate in cases:
        with pytest.raises(CalibrationDataError, match=words) as refusal:
            simulate()
        assert str(refusal.value).count(". ") == 0


def test_an_error_names_the_function_and_no_scratch_folder(observations: Observations) -> None:
    shape = observations.distance_images.shape
    simulator = PythonSimulator(lambda _: {"depth": np.ones(shape), "amplitude": -np.ones(shape)})
    with pytest.raises(CalibrationDataError) as refusal:
        simulator.simulate(observations, OPTIONS)
    assert str(refusal.value).startswith(
        "the frames that the function returned/amplitude.npy: frame 0, row 0"
    )
    with pytest.raises(CalibrationDataError, match=r"Use tensor\.detach\(\)"):
        PythonSimulator(lambda _: torch.ones(shape, requires_grad=True)).simulate(
            observations, OPTIONS
        )
    with pytest.raises(ConfigError, match=r"got ndarray\. Frames in memory are handed over"):
        open_simulator(np.ones(shape))  # type: ignore[arg-type]


@pytest.mark.parametrize("guess", [None, {"translation_mm": 3.0, "rotation_deg": 0.0}])
def test_a_recording_of_the_built_in_simulator_is_one_once_its_guess_is_exact(
    guess: dict[str, float] | None, tmp_path: Path
) -> None:
    """A guess 3 mm off was taken as exact, and the gap was called the mounting of the camera."""
    few = {"shots": [{"target": "white", "poses": 20}]}
    changes = few if guess is None else few | {"hand_eye": {"guess": guess}}
    guessed = diagnosed_recordings.recorded(tmp_path / "guess", 5, changes=changes)
    with pytest.raises(CalibrationDataError, match=r"--set hand_eye\.guess\.translation_mm=0"):
        refuse_mistaken_geometry(guessed)
    true = diagnosed_recordings.options(5, changes=changes).hand_eye.tool_from_camera()
    refuse_mistaken_geometry(replace(guessed, tool_from_camera=true.numpy()))
    exact = few | {"hand_eye": {"guess": {"translation_mm": 0.0, "rotation_deg": 0.0}}}
    refuse_mistaken_geometry(diagnosed_recordings.recorded(tmp_path / "exact", 5, changes=exact))


def test_a_transform_that_a_function_returned_is_not_called_that_of_a_file(
    observations: Observations,
) -> None:
    """It was refused as "recording.yaml: 'tool_from_camera': ..."."""
    depth = np.ones(observations.distance_images.shape)
    for wrong in (np.diag([1.0, 1.0, -1.0, 1.0]), np.full((4, 4), np.nan)):
        frames = {"depth": depth, "tool_from_camera": wrong}
        with pytest.raises(CalibrationDataError) as refusal:
            PythonSimulator(lambda _, frames=frames: frames).simulate(observations, OPTIONS)
        assert str(refusal.value).startswith("The simulator's tool_from_camera: ")


def test_a_folder_that_is_no_recording_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"no recording\.yaml"):
        open_simulator(tmp_path)
