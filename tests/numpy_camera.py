"""A camera before a wall, written in NumPy: shares no code with simulator or estimators."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from cameras import rigid
from scipy.ndimage import convolve1d
from scipy.spatial.transform import Rotation

from tofcorr.data.recording import Recording
from tofcorr.data.table import FrameRow
from tofcorr.data.writing import write_recording
from tofcorr.geometry.camera import CameraIntrinsics

WIDTH, HEIGHT = 40, 32
REFERENCE = 1000.0
"""Amplitude at which floor, shot and read noise are stated, counts."""


@dataclass(frozen=True, kw_only=True)
class Camera:
    """A camera: noise of its parts at the reference (metres), and what else it does."""

    times: float = 1.0
    floor: float = 0.5e-3
    shot: float = 1.5e-3
    read: float = 0.8e-3
    filter_px: float = 0.0
    pattern: float = 0.0
    threshold: float = 0.0
    base_share: float = 0.0
    saturation: float = np.inf  # no distance from this amplitude on, which is stated in its place
    mixed_frames: float = 0.0  # share of each frame that the camera takes from the one before
    gain: float = 1.0
    has_amplitude: bool = True

    def sigma(self, amplitude: np.ndarray) -> np.ndarray:
        """Return the standard deviation of the noise, metres."""
        dark = REFERENCE * self.gain / amplitude
        parts = self.floor**2 + self.shot**2 * dark + self.read**2 * dark**2
        return self.times * np.sqrt(parts)


@dataclass(frozen=True, kw_only=True)
class Truth:
    """The recording, and shares and noise that were drawn into it.

    Attributes:
        recording: What was written.
        missing_share: Of the pixels.
        noise: Root mean square over the pixels with a distance, metres.
        variance: Of the noise of each pixel with a distance, shape (N, H, W), m^2; NaN elsewhere.
    """

    recording: Recording
    missing_share: float
    noise: float
    variance: np.ndarray


def record(
    folder: Path,
    camera: Camera,
    seed: int,
    *,
    poses_seed: int = 0,
    poses: int = 24,
    repeats: int = 1,
) -> Truth:
    """Take `repeats` frames at every pose; every second target is a checkerboard."""
    drawn, random = np.random.default_rng(poses_seed), np.random.default_rng(seed)
    focal = 1.4 * WIDTH
    matrix = ((focal, 0.0, (WIDTH - 1) / 2), (0.0, focal, (HEIGHT - 1) / 2), (0.0, 0.0, 1.0))
    u, v = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    rays = np.stack([(u - matrix[0][2]) / focal, (v - matrix[1][2]) / focal, np.ones_like(u)], -1)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    pattern = camera.pattern * random.standard_normal((HEIGHT, WIDTH))
    depth, amplitudes, rows, variances = [], [], [], []
    for pose in range(poses):
        world_from_camera = _looking_at_wall(drawn)
        towards = rays @ world_from_camera[:3, :3].T
        true = -world_from_camera[2, 3] / towards[..., 2]
        place = world_from_camera[:3, 3] + true[..., None] * towards
        board = (np.floor(place[..., 0] / 0.15) + np.floor(place[..., 1] / 0.15)) % 2 > 0
        reflectivity = np.where(board, 0.8, 0.15) if pose % 2 else 0.7
        light = 1.5 * REFERENCE * reflectivity * -towards[..., 2] / true**2
        light = light * camera.gain * rays[..., 2] ** 2
        noise = camera.sigma(light) * _white(random, camera.filter_px)
        for _ in range(repeats):
            fresh = camera.sigma(light) * _white(random, camera.filter_px)
            kept = camera.mixed_frames  # In the long run the noise has the variance of one frame.
            noise = kept * noise + (1 - kept**2) ** 0.5 * fresh
            seen = light * (1 + 0.01 * random.standard_normal(light.shape))
            lost = (seen < camera.threshold) | (random.random(light.shape) < camera.base_share)
            lost |= seen >= camera.saturation
            seen = np.minimum(seen, camera.saturation)
            variances.append(np.where(lost, np.nan, camera.sigma(light) ** 2))
            depth.append(np.where(lost, np.nan, true + noise + pattern))
            amplitudes.append(seen)
            target = "checkerboard" if pose % 2 else "white"
            plane = {"normal_world": np.array([0.0, 0.0, 1.0]), "offset": 0.0, "target": target}
            own = {"timestamp": float(len(rows)), "pose_id": str(pose) if repeats > 1 else None}
            rows.append(FrameRow(world_from_tool=world_from_camera, **plane, **own))
    write_recording(
        folder,
        camera=CameraIntrinsics(width=WIDTH, height=HEIGHT, matrix=matrix, distortion=()),
        depth_kind="radial",
        rows=rows,
        depth=np.array(depth, dtype=np.float32),
        amplitude=np.array(amplitudes, dtype=np.float32) if camera.has_amplitude else None,
    )
    return Truth(
        recording=Recording.open(folder),
        missing_share=float(np.isnan(depth).mean()),
        noise=float(np.nanmean(variances) ** 0.5),
        variance=np.array(variances),
    )


def _looking_at_wall(random: np.random.Generator) -> np.ndarray:
    angles, distance = random.uniform(-0.5, 0.5, 2), random.uniform(0.6, 1.8)
    turn = Rotation.from_euler("XY", angles) * Rotation.from_matrix(np.diag([1.0, -1.0, -1.0]))
    return rigid(turn, -distance * turn.as_matrix()[:, 2])


def _white(random: np.random.Generator, width: float) -> np.ndarray:
    """Draw noise of variance one, filtered by a Gaussian of this width in pixels."""
    drawn = random.standard_normal((HEIGHT + 20, WIDTH + 20))
    if width > 0:
        weights = np.exp(-0.5 * (np.arange(-8, 9) / width) ** 2)
        for axis in (0, 1):
            drawn = convolve1d(drawn, weights, axis, mode="constant")
        drawn /= weights @ weights
    return drawn[10:-10, 10:-10]
