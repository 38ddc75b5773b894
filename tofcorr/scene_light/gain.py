r"""The gain of second bounces, found from the curvature that they give to planes.

What is wrong with a plane's distance, tilt or place cannot be told from the plane itself. So of
every large plane of a frame that much is left free, and the gain s is found from the rest, together
with the coefficients of the base error's functions f:

.. math:: r - \frac{1}{g \cdot \mathrm{ray}} = r^2 \, a \cdot \mathrm{ray}
    + \sum_k \beta_k f_k(r, A) + s \, \frac{\delta(s)}{s} + \text{noise}

:math:`\delta` is what second bounces add to the distance. It is almost proportional to s, and found
anew with every s.
"""

import math
from collections.abc import Callable, Iterable
from typing import NamedTuple

import torch
from torch import Tensor

from tofcorr.errors import CalibrationDataError
from tofcorr.scene_light.bounces import SecondBounces

Frames = Iterable[tuple[Tensor, Tensor]]
"""Distances along the ray, metres, and amplitudes, (H, W) each."""
Functions = Callable[[Tensor, Tensor], Tensor]
"""Of distances (N,), metres, and amplitudes (N,): the base error's functions (K, N)."""

CONFIDENCE = 0.95
"""Probability of the interval of the gain."""


class GainFit(NamedTuple):
    """The gain, and how well it is known.

    Attributes:
        gain: s, one over the camera's units.
        standard_error: Of the gain, from the scatter between planes.
        interval: Of 95 %.
        coefficients: Of the base error's functions (K,), metres.
        planes: How many were used.
    """

    gain: float
    standard_error: float
    interval: tuple[float, float]
    coefficients: Tensor
    planes: int


@torch.no_grad()
def fit_gain(
    bounces: SecondBounces, frames: Frames, functions: Functions, poses: Tensor
) -> GainFit:
    """Fit the gain to frames of planes that light each other.

    Args:
        bounces: Camera, frequencies and light; its gain is where the search starts.
        frames: That show planes.
        functions: Of the base error that is to be fitted as well.
        poses: World from camera, one of each frame (B, 4, 4), for a room that stands there.

    Raises:
        CalibrationDataError: There are too few planes, or no second bounces bend them.
    """
    from scipy.special import stdtrit  # Slow to import.

    seen = [(pose, *bounces.cells(*one)) for one, pose in zip(frames, poses, strict=True)]
    started, last = bounces.gain, math.inf
    gain = started
    try:
        while True:
            found, error, planes = _solved(bounces, seen, functions)
            change, gain = abs(float(found[-1]) - gain), float(found[-1])
            # Until it changes by less than its own uncertainty, or by no less than before.
            if not error < change < last:
                break
            last, bounces.gain = change, max(gain, bounces.gain / 2)  # A step may overshoot.
    finally:
        bounces.gain = started
    reach = float(stdtrit(planes - len(found), (1 + CONFIDENCE) / 2)) * error
    if not gain > reach:
        raise CalibrationDataError(
            f"The gain of second bounces is not determined: {gain:.2g} +- {reach:.2g}. "
            "Record walls with bright floor or side walls in view."
        )
    return GainFit(gain, error, (gain - reach, gain + reach), found[:-1], planes)


def _solved(
    bounces: SecondBounces, seen: list[tuple[Tensor, Tensor, Tensor]], functions: Functions
) -> tuple[Tensor, float, int]:
    """Return coefficients and gain (K + 1,), the gain's standard error, and how many planes."""
    parts = [part for frame in seen for part in _columns(bounces, *frame, functions)]
    unknowns = parts[0][0].shape[1] if parts else 1
    if len(parts) <= unknowns:
        raise CalibrationDataError(
            f"The gain of second bounces needs planes in view, at least {unknowns + 1}: "
            f"got {len(parts)}. Record walls with floor or side walls in view."
        )
    normal = torch.stack([x.T @ x for x, _ in parts]).sum(0)
    inverse = torch.linalg.pinv(normal, hermitian=True)
    found = inverse @ torch.stack([x.T @ y for x, y in parts]).sum(0)
    scores = torch.stack([x.T @ (y - x @ found) for x, y in parts])
    covariance = inverse @ (scores.T @ scores) @ inverse * (len(parts) / (len(parts) - unknowns))
    return found, float(covariance[-1, -1].sqrt()), len(parts)


def _columns(
    bounces: SecondBounces, pose: Tensor, radial: Tensor, amplitude: Tensor, functions: Functions
) -> list[tuple[Tensor, Tensor]]:
    """Return columns (M, K + 1) and values (M,) of every plane, free of what moves the plane."""
    bounces.room.set_pose(pose)
    shift, planes, large = bounces.found(radial, amplitude)
    usable = large & shift.isfinite() & radial.isfinite()
    if not usable.any():
        return []
    radial, amplitude, shift = radial[usable], amplitude[usable], shift[usable]
    ray, planes = bounces.cell_rays.double()[:, usable], planes[:, usable]
    smooth = 1.0 / (planes * ray).sum(0)
    values = radial - smooth
    # At the plane: functions of the measured distance would explain its noise, and second bounces.
    columns = torch.cat([functions(smooth, amplitude), shift[None] / bounces.gain]).T
    moves, parts = (smooth.square() * ray).T, []
    _, plane = planes.unique(dim=1, return_inverse=True)
    for number in range(int(plane.max()) + 1):
        own = plane == number
        if own.sum() > bounces.cell_planes.side**2:
            base = torch.linalg.qr(moves[own]).Q
            held = torch.cat([columns[own], values[own, None]], dim=1)
            held = held - base @ (base.T @ held)
            parts.append((held[:, :-1], held[:, -1]))
    return parts
