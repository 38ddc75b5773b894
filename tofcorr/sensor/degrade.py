"""A recording of an ideal camera, as the real camera would have given it."""

import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from tofcorr.conditions import CONDITIONS, condition
from tofcorr.data.recording import Recording
from tofcorr.data.writing import RecordingWriter
from tofcorr.errors import CalibrationDataError
from tofcorr.geometry import se3
from tofcorr.geometry.rays import ray_directions
from tofcorr.progress import through
from tofcorr.scene_light.surroundings import sampled, surroundings_of
from tofcorr.sensor.model import Around, SensorModel
from tofcorr.sensor.scene import conditions_of
from tofcorr.sensor.sensor_file import SensorFile, read_sensor

AmplitudeMeaning = Literal["amplitude", "reflectivity"]
"""What `amplitude.npy` of the ideal recording holds: the camera's own units, or a share 0 to 1."""

# Reflectivity above which the numbers are of another kind. Chosen: gloss returns a few times what
# white paint does, and images of 8 bits hold tens.
_MOST_REFLECTED = 10.0


@dataclass(frozen=True)
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
) -> Degraded:
    """Write what a camera would have measured where an ideal one recorded.

    Poses, planes and all other columns are copied. `true_depth.npy` keeps the ideal depth: that of
    the recording, or its `depth.npy` if it has no other.

    Args:
        sensor: The camera: a model, its file, a shipped name such as `"kinect_v2"`.
        recording: The ideal recording, or its folder, of any scene, rendered with the camera's
            intrinsics. Its amplitude may be missing: the sensor's usual reflectivity is then used.
        out: The folder to write; it must not exist yet.
        seed: Of all draws; each frame has its own.
        amplitude_is: What the amplitude of the recording holds.

    Raises:
        ConfigError: There is no such sensor, or its file breaks the format.
        CalibrationDataError: The recording is of another camera, a reflectivity is above 10, or
            `out` exists.
        FrameError: The sensor needs amplitudes and nothing says them.
    """
    if not isinstance(sensor, SensorModel):
        sensor = SensorModel(sensor if isinstance(sensor, SensorFile) else read_sensor(sensor))
    if not isinstance(recording, Recording):
        recording = Recording.open(recording, check_contents=False)
    file, model = sensor.sensor, sensor
    _refuse_another_camera(recording, file)
    saturation = file.dropouts and file.dropouts.saturation_amplitude
    header = replace(
        recording,
        depth_kind=file.depth_kind,
        modulation_frequency=file.modulation_frequency_hz or recording.modulation_frequency,
        saturation_amplitude=saturation or recording.saturation_amplitude,
    )
    slant = ray_directions(recording.camera)[..., 2].float()
    kinds = {"z": slant, "radial": torch.ones_like(slant)}
    scale = kinds[file.depth_kind] / kinds[recording.depth_kind]
    source = "depth" if recording.true_depth is None else "true_depth"
    counts = np.zeros(3, dtype=np.int64)

    def ideal(number: int) -> tuple[Tensor, Tensor | None]:
        """Return true depth, of the sensor's kind, and light of a frame, (H, W) each."""
        depth, light = (recording.read(name, np.array([number])) for name in (source, "amplitude"))
        assert depth is not None
        lit = None if light is None else torch.from_numpy(light[0])
        if amplitude_is == "reflectivity" and lit is not None:
            _refuse_no_share(recording, lit, number)
        return torch.from_numpy(depth[0]) * scale, lit

    with RecordingWriter.like(out, header) as writer, torch.inference_mode():
        shift = model.frame_shift(recording.num_frames, **conditions_of_frames(recording))
        around = None
        if model.bounces is not None and recording.moves:
            around = _around(model, recording, ideal, amplitude_is)
            ending = model.to_sensor_file().ending_with_the_image()
            model = SensorModel(ending, model.eye.ray_directions.dtype) if around else model
        for number in through(range(recording.num_frames), "degrading"):
            true_depth, lit = ideal(number)
            mask = recording.read("mask", np.array([number]))
            # A seed of one frame, independent of those of all other frames and seeds.
            own = np.random.SeedSequence([seed, number]).generate_state(1, np.uint64)[0]
            if model.bounces is not None:
                pose = recording.frames.world_from_tool[number] @ recording.tool_from_camera
                model.bounces.room.set_pose(torch.from_numpy(pose))
            measured = model(
                true_depth,
                **{amplitude_is: lit},
                generator=torch.Generator().manual_seed(int(own >> 1)),
                frame_shift=shift[number],
                around=around and around.of(slice(number, number + 1)),
                **conditions_of_frames(recording, number),
            )
            writer.append(
                measured.depth.numpy(),
                amplitude=None if measured.amplitude is None else measured.amplitude.numpy(),
                mask=None if mask is None else mask[0],
                true_depth=true_depth.numpy(),
            )
            there = torch.isfinite(true_depth) & (true_depth > 0)
            covered = model.covers(true_depth) & there
            counts += [int(each.sum()) for each in (there, measured.valid, covered)]
    valid_share, covered_share = (counts[1:] / max(counts[0], 1)).tolist()
    # Then most of the result rests on errors at the edge of a range, or the unit is wrong.
    if counts[0] and covered_share < 0.5:
        near, far = file.validity.radial_distance_m
        said = f"{100 * covered_share:.0f} % of its pixels are at distances that the sensor was"
        beyond = "beyond, the error at the range's edge was used. Is the depth in metres?"
        _warn(f"{recording.path}: {said} measured at, {near:.2g} to {far:.2g} m; {beyond}")
    written = Recording.open(out, check_contents=False)
    return Degraded(written, valid_share, covered_share, model.left_out)


def _around(
    model: SensorModel,
    recording: Recording,
    ideal: Callable[[int], tuple[Tensor, Tensor | None]],
    amplitude_is: AmplitudeMeaning,
) -> Around | None:
    """Return the planes that the frames of a robot show, and its poses; None: there is one."""
    rays, found = model.eye.ray_directions.double().flatten(0, 1), list[tuple[Tensor, Tensor]]()
    pixel = sampled(rays)
    for number in range(recording.num_frames):
        depth, lit = ideal(number)
        given: dict[str, Tensor | None] = {"amplitude": None, "reflectivity": None}
        given[amplitude_is] = None if lit is None else lit[None]
        known = conditions_of(conditions_of_frames(recording, number), (1,), rays.device, {})
        seen = model.eye(depth[None], **given, conditions=known, needs_amplitude=True)
        distance = torch.where(seen.seen, seen.distance, torch.nan)
        light = model.usual_light(seen)
        found.append((distance.flatten()[pixel], light.flatten()[pixel]))
    distance, amplitude = (torch.stack(images) for images in zip(*found, strict=True))
    poses = torch.from_numpy(recording.frames.world_from_tool @ recording.tool_from_camera)
    planes = surroundings_of(distance, amplitude, rays[pixel], poses, rays.new_zeros(0, 4))
    return None if len(planes.offset) < 2 else Around(planes._replace(direct=True), poses)


def conditions_of_frames(
    recording: Recording, frame: int | None = None
) -> dict[str, float | Tensor]:
    """Return what is recorded of all frames, each (N,), or of one, in the units of files."""
    known: dict[str, float | Tensor] = {}
    for name in CONDITIONS:
        values = getattr(recording.frames, name)
        if values is not None and not np.isnan(values).any():
            in_file = torch.from_numpy(condition(name).in_file(values))
            known[condition(name).column] = in_file if frame is None else float(in_file[frame])
    return known


def _refuse_another_camera(recording: Recording, sensor: SensorFile) -> None:
    """Refuse frames of another size; warn of those of another lens or hand-eye transform."""
    camera, own = recording.camera, sensor.intrinsics()
    if (camera.width, camera.height) != (own.width, own.height):
        sizes = f"{camera.width}x{camera.height} pixels, the sensor has {own.width}x{own.height}"
        said = f"frames are {sizes}. Render with the intrinsics of the sensor."
        raise CalibrationDataError(f"{recording.path}: {said}")
    if not torch.allclose(ray_directions(camera), ray_directions(own)):
        said = "its intrinsics are not the sensor's, whose error each pixel gets"
        _warn(f"{recording.path}: {said}; render with the sensor's to avoid this.")
    given, found = recording.tool_from_camera, sensor.tool_from_camera
    if found is None or np.allclose(given, np.eye(4)):  # The identity: no robot, or unknown.
        return
    shift, turn = se3.apart(torch.as_tensor(given), torch.tensor(found, dtype=torch.float64))
    if 1000 * max(shift, turn) > 1:  # What a robot repeats.
        away = f"{1e3 * shift:.1f} mm and {np.degrees(turn):.2f} degrees from that of the sensor"
        advice = "If they are frames of its robot, render them with that of sensor.yaml."
        _warn(f"{recording.path}: its tool_from_camera is {away}. {advice}")


def _warn(sentence: str) -> None:
    warnings.warn(sentence, UserWarning, stacklevel=3)


def _refuse_no_share(recording: Recording, light: Tensor, number: int) -> None:
    most = float(light.nan_to_num(0.0).max())
    if most > _MOST_REFLECTED:
        said = f"a reflectivity is a share from 0 to 1, got {most:.6g}; divide by what white has"
        raise CalibrationDataError(f"{recording.path}: frame {number}, amplitude: {said}.")
