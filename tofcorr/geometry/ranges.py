"""Conversions between radial distance, z depth and phase."""

import math

import numpy as np
from torch import Tensor

from tofcorr.errors import FrameError

SPEED_OF_LIGHT = 299_792_458.0
"""In vacuum, metres per second. Exact by the definition of the metre."""
# How far an error may be from a whole number of unambiguous ranges, metres. Chosen: twice what
# errors of cameras reach; a seventh of all errors would be so near by chance at 100 MHz.
_WRAPPED_WITHIN = 0.1
# Share of large errors that must be wrapped so that wrapping is what they have in common. Chosen:
# edges are some of them.
_MOSTLY = 0.5


def radial_distance_from_z_depth(z_depth: Tensor, ray_directions: Tensor) -> Tensor:
    """Convert the coordinate along the optical axis into the distance along the ray.

    Args:
        z_depth: Coordinates along the optical axis, shape (..., H, W), metres.
        ray_directions: Unit viewing rays, shape (H, W, 3).

    Returns:
        Radial distances, shape (..., H, W), metres.
    """
    _check_sizes(z_depth, ray_directions, "z_depth")
    return z_depth / ray_directions[..., 2].to(z_depth)


def z_depth_from_radial_distance(radial_distance: Tensor, ray_directions: Tensor) -> Tensor:
    """Convert the distance along the ray into the coordinate along the optical axis.

    Args:
        radial_distance: Distances along the rays, shape (..., H, W), metres.
        ray_directions: Unit viewing rays, shape (H, W, 3).

    Returns:
        Coordinates along the optical axis, shape (..., H, W), metres.
    """
    _check_sizes(radial_distance, ray_directions, "radial_distance")
    return radial_distance * ray_directions[..., 2].to(radial_distance)


def unambiguous_range(modulation_frequency: float) -> float:
    """Return c / 2f in metres: the distance after which the phase repeats."""
    return SPEED_OF_LIGHT / (2.0 * modulation_frequency)


def wrapped(errors: np.ndarray, modulation_frequency: float | None) -> np.ndarray:
    """Return which errors are whole unambiguous ranges, as where a phase wrapped, same shape.

    A camera measures a distance beyond its unambiguous range as nearer by that range. One that
    combines several frequencies may take the wrong period, and is off by several ranges of one.

    Args:
        errors: Measured less true distances, any shape, metres.
        modulation_frequency: In Hz; None: unknown, and no error is.
    """
    if modulation_frequency is None:
        return np.zeros(errors.shape, dtype=bool)
    periods = errors / unambiguous_range(modulation_frequency)
    whole = np.round(periods)
    off = np.abs(periods - whole) * unambiguous_range(modulation_frequency)
    return (whole != 0) & (off < _WRAPPED_WITHIN)


def range_of_wrapped(errors: np.ndarray, modulation_frequency: float | None) -> float | None:
    """Return the unambiguous range if most of some large errors are whole multiples of it.

    Args:
        errors: Of pixels that are far off, any shape, metres.
        modulation_frequency: In Hz; None: unknown.

    Returns:
        The range, metres; None if they have something else in common, or there are none.
    """
    if modulation_frequency is None or not errors.size:
        return None
    mostly = wrapped(errors, modulation_frequency).mean() > _MOSTLY
    return unambiguous_range(modulation_frequency) if mostly else None


def phase_from_radial_distance(radial_distance: Tensor, modulation_frequency: float) -> Tensor:
    """Return the phase 4 pi f D / c in radians, not wrapped."""
    return radial_distance * (2.0 * math.pi / unambiguous_range(modulation_frequency))


def _check_sizes(distances: Tensor, ray_directions: Tensor, name: str) -> None:
    if distances.shape[-2:] != ray_directions.shape[:2]:
        raise ValueError(
            f"{name} and ray_directions must share (H, W): got {list(distances.shape[-2:])} and "
            f"{list(ray_directions.shape[:2])}. Were the rays built for another resolution or crop?"
        )


def multiples_in_words(size: float) -> str:
    """Return what errors by whole unambiguous ranges are off by; to follow "off by".

    Args:
        size: The unambiguous range, metres.
    """
    return f"{size:.2f} m or a multiple of it, the unambiguous range"


def refuse_other_than_tensor(name: str, frame: object) -> None:
    """Refuse a frame that is no tensor, by the name that its caller knows.

    Raises:
        FrameError: It is something else; the message says how to make a tensor of it.
    """
    if not isinstance(frame, Tensor):
        raise FrameError(
            f"{name}: expected a torch tensor, got {type(frame).__name__}. Make one with "
            "torch.tensor(array), or torch.full(shape, number)."
        )
