"""The frames of an ideal recording, in the form that a sensor model takes."""

import warnings
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from tofcorr.conditions import CONDITIONS, condition
from tofcorr.data.recording import Recording
from tofcorr.errors import CalibrationDataError
from tofcorr.geometry.camera import CameraIntrinsics
from tofcorr.geometry.rays import ray_directions
from tofcorr.sensor.sensor_file import SensorFile

AmplitudeMeaning = Literal["amplitude", "reflectivity"]
"""What `amplitude.npy` of the ideal recording holds: the camera's own units, or a share 0 to 1."""

# Largest difference of focal lengths, principal points (pixels) and distortion (no unit) at which
# two lenses are one. Chosen: a tenth of what a calibration determines.
_SAME_LENS = 0.02
# Reflectivity above which the numbers are of another kind. Chosen: gloss returns a few times what
# white paint does, and images of 8 bits hold tens.
_MOST_REFLECTED = 10.0


@dataclass(frozen=True, kw_only=True)
class IdealFrame:
    """One ideal frame.

    Attributes:
        number: In the recording.
        true_depth: Of the sensor's kind, shape (H, W), float32, metres.
        amplitude: The camera's units, shape (H, W); None if the scene states none.
        reflectivity: Shape (H, W), 0 to 1; None if the scene states none.
        mask: Shape (H, W), uint8, 1 on the target; None: 1 everywhere.
    """

    number: int
    true_depth: Tensor
    amplitude: Tensor | None
    reflectivity: Tensor | None
    mask: np.ndarray | None

    @property
    def there(self) -> Tensor:
        """Where a surface is, shape (H, W), bool."""
        return torch.isfinite(self.true_depth) & (self.true_depth > 0)


class IdealFrames:
    """Reads the frames of an ideal recording for one sensor.

    Args:
        recording: Rendered with the intrinsics of the sensor.
        sensor: The camera.
        amplitude_is: What the amplitude of the recording holds.

    Raises:
        CalibrationDataError: The recording is of another image size.
    """

    def __init__(
        self, recording: Recording, sensor: SensorFile, amplitude_is: AmplitudeMeaning
    ) -> None:
        _refuse_another_camera(recording, sensor)
        self._recording = recording
        self._sensor = sensor
        self._amplitude_is = amplitude_is
        slant = ray_directions(recording.camera)[..., 2].to(torch.float32)
        ones = torch.ones_like(slant)
        own = slant if recording.depth_kind == "z" else ones
        wanted = slant if sensor.depth_kind == "z" else ones
        self._to_kind = wanted / own

    def header(self) -> Recording:
        """Return the recording with what the sensor states in its header."""
        recording, sensor = self._recording, self._sensor
        level = None if sensor.dropouts is None else sensor.dropouts.saturation_amplitude
        return replace(
            recording,
            depth_kind=sensor.depth_kind,
            modulation_frequency=sensor.modulation_frequency_hz or recording.modulation_frequency,
            saturation_amplitude=level or recording.saturation_amplitude,
        )

    def conditions(self, frame: int | None = None) -> dict[str, float | Tensor]:
        """Return what is recorded of all frames, each (N,), or of one, in the units of files."""
        known: dict[str, float | Tensor] = {}
        for name in CONDITIONS:
            values = getattr(self._recording.frames, name)
            if values is None or np.isnan(values).any():
                continue
            in_file = condition(name).in_file(values)
            one = in_file if frame is None else in_file[frame : frame + 1]
            known[condition(name).column] = (
                torch.from_numpy(one) if frame is None else float(one[0])
            )
        return known

    def read(self, chunk: np.ndarray) -> Iterator[IdealFrame]:
        """Yield some frames, read at once.

        Raises:
            CalibrationDataError: A reflectivity is no share.
        """
        recording = self._recording
        source = "depth" if recording.true_depth is None else "true_depth"
        depth = recording.read(source, chunk)
        amplitude, mask = recording.read("amplitude", chunk), recording.read("mask", chunk)
        assert depth is not None
        for place, number in enumerate(chunk.tolist()):
            light = None if amplitude is None else torch.from_numpy(amplitude[place])
            is_share = self._amplitude_is == "reflectivity"
            if is_share and light is not None:
                self._refuse_no_share(light, number)
            yield IdealFrame(
                number=number,
                true_depth=torch.from_numpy(depth[place]) * self._to_kind,
                amplitude=None if is_share else light,
                reflectivity=light if is_share else None,
                mask=None if mask is None else mask[place],
            )

    def _refuse_no_share(self, light: Tensor, number: int) -> None:
        most = float(light.nan_to_num(0.0).max())
        if most > _MOST_REFLECTED:
            raise CalibrationDataError(
                f"{self._recording.path}: frame {number}, amplitude: a reflectivity is a share "
                f"from 0 to 1, a little more in highlights, got {most:.6g}; divide by what white "
                "has (255 in images of 8 bits)."
            )


def _refuse_another_camera(recording: Recording, sensor: SensorFile) -> None:
    camera, own = recording.camera, sensor.intrinsics()
    if (camera.width, camera.height) != (own.width, own.height):
        raise CalibrationDataError(
            f"{recording.path}: frames are {camera.width}x{camera.height} pixels, the sensor has "
            f"{own.width}x{own.height}. Render with the intrinsics of the sensor."
        )
    if np.abs(_lens(camera) - _lens(own)).max() > _SAME_LENS:
        warnings.warn(
            f"{recording.path}: its intrinsics are not those of the sensor. Each pixel gets the "
            "sensor's error for that pixel; render with the sensor's intrinsics to avoid this.",
            UserWarning,
            stacklevel=4,
        )


def _lens(camera: CameraIntrinsics) -> np.ndarray:
    """Return K and distortion as one vector, distortion filled with zeros to 14."""
    distortion = [*camera.distortion, *[0.0] * (14 - len(camera.distortion))]
    return np.concatenate([np.array(camera.matrix).reshape(-1), np.array(distortion)])
