"""A recording of an ideal camera, as the real camera would have given it."""

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from tofcorr.data.recording import Recording
from tofcorr.data.writing import RecordingWriter
from tofcorr.geometry import se3
from tofcorr.sensor.ideal_frames import AmplitudeMeaning, IdealFrame, IdealFrames
from tofcorr.sensor.model import Measurement, SensorModel
from tofcorr.sensor.sensor_file import SensorFile

# Largest difference of two hand-eye transforms that count as one, metres and radians. Chosen: what
# a robot repeats.
_SAME_PLACE, _SAME_ANGLE = 1e-3, 1e-3

# Fewer pixels than this share at distances that the sensor was measured at are worth a warning.
# Chosen: then most of the result rests on errors at the edge of a range, or the unit is wrong.
_USUALLY_COVERED = 0.5


@dataclass(frozen=True, kw_only=True)
class Degraded:
    """What was written.

    Attributes:
        recording: The degraded recording.
        valid_share: Share of the pixels with a true distance that the camera gives a valid one for.
        covered_share: Share of them at distances that the sensor was measured at; beyond, the error
            at the range's edge was used.
        left_out: Effects that no depth image can show, and why, a sentence each.
    """

    recording: Recording
    valid_share: float
    covered_share: float
    left_out: tuple[str, ...]


def degrade(
    sensor: SensorModel | SensorFile | Path | str,
    recording: Recording | Path | str,
    out: Path | str,
    *,
    seed: int = 0,
    amplitude_is: AmplitudeMeaning = "amplitude",
    chunk_pixels: int = 1_000_000,
    progress: Callable[[int], object] = lambda frames: None,
) -> Degraded:
    """Write what a camera would have measured where an ideal one recorded.

    Poses, planes and all other columns are copied. `true_depth.npy` keeps the ideal depth: that of
    the recording, or its `depth.npy` if it has no other. Memory is bounded by `chunk_pixels`.

    Args:
        sensor: The camera: a model, its file, a shipped name such as `"kinect_v2"`.
        recording: The ideal recording, or its folder, of any scene, rendered with the camera's
            intrinsics. Its amplitude may be missing: the sensor's usual reflectivity is then used.
        out: The folder to write; it must not exist yet.
        seed: Of all draws. Each frame has its own, so that the result does not depend on
            `chunk_pixels`.
        amplitude_is: What the amplitude of the recording holds.
        chunk_pixels: Pixels measured at once, but at least one frame.
        progress: Called with the number of frames written since the last call.

    Raises:
        ConfigError: There is no such sensor, or its file breaks the format.
        CalibrationDataError: The recording is of another camera, a reflectivity is above 10, or
            `out` exists.
        FrameError: The sensor needs amplitudes and nothing says them.
    """
    model = _model_of(sensor)
    if not isinstance(recording, Recording):
        recording = Recording.open(recording, check_contents=False)
    ideal = IdealFrames(recording, model.sensor, amplitude_is)
    _say_another_hand_eye(recording, model.sensor)
    counts = np.zeros(3, dtype=np.int64)
    with RecordingWriter.like(out, ideal.header()) as writer, torch.inference_mode():
        shift = model.frame_shift(recording.num_frames, **ideal.conditions())
        step = max(1, chunk_pixels // (recording.camera.height * recording.camera.width))
        for start in range(0, recording.num_frames, step):
            chunk = np.arange(start, min(start + step, recording.num_frames))
            for frame in ideal.read(chunk):
                generator = torch.Generator().manual_seed(_frame_seed(seed, frame.number))
                measured = model(
                    frame.true_depth,
                    frame.amplitude,
                    reflectivity=frame.reflectivity,
                    generator=generator,
                    frame_shift=shift[frame.number],
                    **ideal.conditions(frame.number),
                )
                _append(writer, frame, measured)
                covered = model.covers(frame.true_depth) & frame.there
                counts += (int(frame.there.sum()), int(measured.valid.sum()), int(covered.sum()))
            progress(len(chunk))
    valid_share, covered_share = (counts[1:] / max(counts[0], 1)).tolist()
    if counts[0] and covered_share < _USUALLY_COVERED:
        _say_elsewhere(recording, model.sensor, covered_share)
    return Degraded(
        recording=Recording.open(out, check_contents=False),
        valid_share=valid_share,
        covered_share=covered_share,
        left_out=model.left_out,
    )


def _model_of(sensor: SensorModel | SensorFile | Path | str) -> SensorModel:
    if isinstance(sensor, SensorModel):
        return sensor
    return SensorModel(sensor) if isinstance(sensor, SensorFile) else SensorModel.load(sensor)


def _say_another_hand_eye(recording: Recording, sensor: SensorFile) -> None:
    given, found = recording.tool_from_camera, sensor.tool_from_camera
    if found is None or np.allclose(given, np.eye(4)):  # The identity: no robot, or unknown.
        return
    shift, turn = se3.apart(torch.as_tensor(given), torch.tensor(found, dtype=torch.float64))
    if shift > _SAME_PLACE or turn > _SAME_ANGLE:
        warnings.warn(
            f"{recording.path}: its tool_from_camera is {1e3 * shift:.1f} mm and "
            f"{np.degrees(turn):.2f} degrees from that of the sensor. Its errors go with its own: "
            "if these frames stand for the sensor's robot, render them with the tool_from_camera "
            "of sensor.yaml.",
            UserWarning,
            stacklevel=3,
        )


def _say_elsewhere(recording: Recording, sensor: SensorFile, share: float) -> None:
    near, far = sensor.validity.radial_distance_m
    warnings.warn(
        f"{recording.path}: {100 * share:.0f} % of its pixels are at distances that the sensor was "
        f"measured at, {near:.2g} to {far:.2g} m; beyond, the error at the range's edge was used. "
        "Is the depth in metres?",
        UserWarning,
        stacklevel=3,
    )


def _append(writer: RecordingWriter, frame: IdealFrame, measured: Measurement) -> None:
    amplitude = measured.amplitude
    writer.append(
        measured.depth.numpy(),
        amplitude=None if amplitude is None else amplitude.numpy(),
        mask=frame.mask,
        true_depth=frame.true_depth.numpy(),
    )


def _frame_seed(seed: int, frame: int) -> int:
    """Return a seed of one frame; independent of those of all other frames and seeds."""
    return int(np.random.SeedSequence([seed, frame]).generate_state(1, np.uint64)[0] >> 1)
