"""What the poses and the target cover, in numbers, and what a calibration would need besides."""

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from torch import Tensor

from tofcorr.geometry.rays import plane_in_frame
from tofcorr.pixels.dataset import Dataset, Frames
from tofcorr.pixels.lattice import Lattice, lattice_of, spread_pixels

# Least ratio of the brightest to the darkest reflectivity; below it the amplitude is nearly a
# function of distance and place. Set by hand.
ENOUGH_REFLECTIVITY = 2


class Support:
    """What a set of frames covers.

    Args:
        dataset: The recordings.
        frames: Global numbers of the frames.
        tool_from_camera: The hand-eye transform, shape (4, 4).

    Attributes:
        tilt_deg: Standard deviation of the direction of the wall's normal in the camera frame,
            about the axis where it is largest and about the axis perpendicular to that.
        roll_deg: Circular standard deviation of the rotation about the optical axis; None
            without a robot.
        distance_m: Range of the wall's distances along the optical axis. Tilt widens the range
            of the pixels' distances, but that does not help to separate c0 from t_z.
        reflectivity_ratio: 95 % over 5 % quantile of the amplitude relative to that of a uniform
            wall at the same distance, incidence and place; None without amplitudes.
    """

    def __init__(self, dataset: Dataset, frames: Frames, tool_from_camera: Tensor) -> None:
        from scipy.stats import circstd  # Slow to import.

        normal_world, offset, world_from_tool = dataset.planes_and_poses(frames)
        world_from_camera = world_from_tool @ tool_from_camera
        normal, offset = plane_in_frame(normal_world, offset, world_from_camera)
        distance, roll = -offset / normal[:, 2], _roll(world_from_camera, normal_world).numpy()
        self.tilt_deg = _tilt(normal)
        self.roll_deg = math.degrees(circstd(roll)) if dataset.moves else None
        self.distance_m = float(distance.min()), float(distance.max())
        self.reflectivity_ratio = None
        if dataset.has_amplitude:
            self.reflectivity_ratio = _reflectivity_ratio(dataset, frames, tool_from_camera)

    def to_mapping(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        given = vars(self).items()
        return {name: list(one) if isinstance(one, tuple) else one for name, one in given}


# Least standard deviation of the tilt, degrees. On simulated walls c0 and t_z correlate by 0.99 for
# tilts within 2 degrees, by 0.73 within 10 and by 0.42 within 30; tilts uniform within 10 degrees
# have a standard deviation of 5.8.
_ENOUGH_TILT = 5


def shortcomings(
    support: Support, *, moves: bool, with_intensity: bool
) -> Iterator[tuple[bool, str]]:
    """Yield what a calibration would need and the recording does not cover.

    Args:
        support: What it covers.
        moves: Whether a hand-eye transform is estimated.
        with_intensity: Whether the model has an intensity term.

    Yields:
        Whether the result is worse for it in any case, and one sentence.
    """
    strong, weak = support.tilt_deg
    if moves and strong < _ENOUGH_TILT:
        needed = f"(standard deviation {strong:.1f} degrees, {_ENOUGH_TILT} needed on two axes)"
        yield True, f"The camera is hardly tilted {needed}: the hand-eye rests on the model's form."
    elif moves and weak < _ENOUGH_TILT:
        roll = support.roll_deg or 0.0
        # More makes up for tilt about one axis only.
        hint = "" if roll > 10 else f" and hardly rolled ({roll:.1f} degrees)"
        needed = f"(standard deviation about the other {weak:.1f} degrees, {_ENOUGH_TILT} needed)"
        yield False, f"The camera is tilted about one axis only {needed}{hint}: tilt or roll it."
    low, high = support.distance_m
    # Below half of its centre the distance term can hardly be separated from the constant.
    if high - low < (high + low) / 4:
        ends = f"({low:.2f} to {high:.2f} m): c0 cannot be separated from t_z"
        yield False, f"The range of distances is narrow {ends}; add nearer and farther views."
    ratio = support.reflectivity_ratio
    if with_intensity and ratio is not None and ratio < ENOUGH_REFLECTIVITY:
        needed = f"(bright to dark {ratio:.1f} to 1, {ENOUGH_REFLECTIVITY} to 1 needed)"
        yield False, f"The target has one reflectivity {needed}: add a checkerboard or a grey wall."


def _roll(world_from_camera: Tensor, normal_world: Tensor) -> Tensor:
    """Return the angle of the camera's x axis in the wall, from a fixed direction of the world."""
    steepest = normal_world.abs().mean(dim=0).argmin()
    along = torch.eye(3, dtype=normal_world.dtype)[steepest]
    first = along - normal_world * (normal_world @ along)[:, None]
    second = torch.linalg.cross(normal_world, first)
    x = world_from_camera[:, :3, 0]
    return torch.atan2((x * second).sum(-1), (x * first).sum(-1))


def _tilt(normals: Tensor) -> tuple[float, float]:
    mean = torch.nn.functional.normalize(normals.mean(dim=0), dim=0)
    across = normals - (normals @ mean)[:, None] * mean
    centred = across - across.mean(dim=0)
    values = torch.linalg.eigvalsh(centred.T @ centred / max(len(normals) - 1, 1)).clamp(min=0)
    weak, strong = values[-2:].sqrt().tolist()
    return math.degrees(strong), math.degrees(weak)


def _reflectivity_ratio(dataset: Dataset, frames: Frames, tool_from_camera: Tensor) -> float | None:
    """Return the ratio of the target's brightest to its darkest reflectivity.

    It is measured on about 200 000 pixels; None with fewer than 100.
    """
    _, place, logarithm = sample_reflectivity(dataset, frames, tool_from_camera)
    if len(logarithm) < 100:
        return None
    smooth = torch.linalg.lstsq(place, logarithm[:, None], driver="gelsd").solution
    low, high = np.quantile((logarithm - (place @ smooth)[:, 0]).numpy(), (1 / 20, 19 / 20))
    return float(np.exp(high - low))


def sample_reflectivity(
    dataset: Dataset, frames: Frames, tool_from_camera: Tensor, lattice: Lattice | None = None
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the reflectivity of some pixels up to a factor: A D^2 over the cosine of incidence.

    On a Lambertian wall this is its reflectivity times the vignetting at the pixel.

    Args:
        dataset: Recordings with amplitudes.
        frames: Global numbers of the frames.
        tool_from_camera: The hand-eye transform, shape (4, 4).
        lattice: That of the frames; None: it is read.

    Returns:
        Which of the frames each of about 200 000 pixels is of, shape (S,); the six terms of a
        quadratic of the pixel's place, which can describe the vignetting, shape (S, 6); and the
        logarithm of the normalised amplitude, shape (S,).
    """
    lattice = lattice_of(dataset, frames) if lattice is None else lattice
    found = spread_pixels(dataset, frames, lattice, 200_000)
    # Up to 84 degrees.
    found = found.of((found.pixels.amplitude > 0) & (-found.cosine(tool_from_camera) > 1 / 10))
    x, y, one = (
        *(found.ray[:, :2] / found.ray[:, 2:]).unbind(1),
        torch.ones(len(found.ray)).double(),
    )
    light = found.pixels.amplitude * found.pixels.radial_distance.square()
    logarithm = (light / -found.cosine(tool_from_camera)).log()
    return found.frame, torch.stack([one, x, y, x * x, x * y, y * y], dim=1), logarithm
