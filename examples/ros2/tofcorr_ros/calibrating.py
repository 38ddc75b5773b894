"""What the calibrator does, without ROS: a frame of each stop of the robot, and what it teaches."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import torch

import tofcorr
from tofcorr.correction.corrector import DepthCorrector
from tofcorr.correction.export.torchscript import export_torchscript
from tofcorr.data.recording import Recording
from tofcorr.geometry.camera import CameraIntrinsics, DepthKind, FrameNames
from tofcorr.geometry.rays import ray_directions
from tofcorr.importing.intrinsics import intrinsics_from_mapping
from tofcorr.importing.walls.image_planes import WallOptions, plane_masks, planes_of_image
from tofcorr.live.calibration import Known
from tofcorr.live.watch import LivePage


class Stops:
    """Says which images to take: one of each place where the tool stands still.

    Args:
        still_s: How long the tool must have stood still before an image is taken, seconds.
        within: Largest change of any entry of its pose meanwhile, metres or no unit.
    """

    def __init__(self, still_s: float, within: float) -> None:
        self._still_s, self._within = still_s, within
        self._since, self._pose, self._taken = 0.0, np.full((4, 4), np.inf), False

    def takes(self, time: float, pose: np.ndarray) -> bool:
        """Whether to take the image of this time, seconds, and pose of the tool, shape (4, 4)."""
        if not np.abs(pose - self._pose).max() <= self._within:
            self._since, self._pose, self._taken = time, pose, False
        due = not self._taken and time - self._since >= self._still_s
        self._taken |= due
        return due


class Calibrating:
    """A live calibration of one frame for each stop, its page, and the model that it writes.

    The largest plane of an image is taken for the wall, of which there is one.

    Args:
        camera: The intrinsics.
        frames: What the robot calls its frames.
        depth_kind: `z`: along the optical axis; `radial`: along the viewing ray.
        tool_from_camera: Where to start, shape (4, 4).
        config: The model, as of `tofcorr train`.
        folder: Keeps each frame's sums; where it exists, the calibration goes on. Empty: none.
        model: File that gets the corrector whenever the calibration is enough. Empty: none.
        page: Shows what is known.
        wanted_mm: As of `LiveCalibration`.
        wanted_deg: As of `LiveCalibration`.
    """

    def __init__(  # noqa: PLR0913 - what ROS calls parameters
        self,
        camera: CameraIntrinsics,
        frames: FrameNames,
        *,
        depth_kind: DepthKind,
        tool_from_camera: np.ndarray,
        config: str,
        folder: str,
        model: str,
        page: LivePage,
        wanted_mm: float,
        wanted_deg: float,
    ) -> None:
        self.camera, self.page, self._model = camera, page, model
        self._rays, self._depth_kind = ray_directions(camera), depth_kind
        if folder and Path(folder).exists():
            self.live = tofcorr.LiveCalibration.resume(folder)
        else:
            like = Recording(
                path=Path(folder or "camera"),
                camera=camera,
                depth_kind=depth_kind,
                tool_from_camera=tool_from_camera,
                planes="estimated",
                frame_names=frames,
            )
            self.live = tofcorr.LiveCalibration(
                like, config, folder=folder or None, wanted_mm=wanted_mm, wanted_deg=wanted_deg
            )
        page.publish(self.live)

    def take(
        self, depth: np.ndarray, amplitude: np.ndarray | None, pose: np.ndarray, time: float
    ) -> Known:
        """Add an image (H, W) of the tool's pose world_from_tool (4, 4), and show what is known.

        Raises:
            TofcorrError: It cannot be used; the message says why.
        """
        known = self.live.add(depth, amplitude, pose, mask=self.wall(depth), timestamp=time)
        self.page.add(known, depth)
        self.page.publish(self.live)
        if known.enough and self._model:
            state = self.live.state()
            export_torchscript(DepthCorrector.from_state(state), Path(self._model), state)
        return known

    def wall(self, depth: np.ndarray) -> np.ndarray:
        """Return which pixels show the largest plane, shape (H, W).

        Raises:
            CalibrationDataError: The size is another, or nothing flat is large enough.
        """
        if depth.shape != tuple(self._rays.shape[:2]):
            size = f"{self.camera.width}x{self.camera.height}"
            said = f"{depth.shape[1]}x{depth.shape[0]} pixels; camera_info says {size}."
            raise tofcorr.CalibrationDataError(said)
        options, distance = WallOptions(), torch.from_numpy(depth).double()
        if self._depth_kind == "z":
            distance = distance / self._rays[..., 2]
        valid = distance > 0
        found = planes_of_image(distance.nan_to_num(0.0), valid, self._rays, options)
        if not found:
            raise tofcorr.CalibrationDataError("no wall: nothing flat covers 5 % of the image.")
        gradients = torch.stack([-one.normal / one.offset for one in found])
        tolerance = options.tolerance_mm / 1000
        return plane_masks(distance, valid, self._rays, gradients, tolerance)[0].numpy()


def intrinsics(
    k: Iterable[float], d: Iterable[float], model: str, width: int, height: int
) -> CameraIntrinsics:
    """Return the intrinsics that a CameraInfo states.

    Raises:
        CalibrationDataError: The lens model is not supported.
    """
    values = {"K": list(k), "distortion": list(d), "distortion_model": model or "none"}
    return intrinsics_from_mapping(values, "camera_info").camera((width, height))
