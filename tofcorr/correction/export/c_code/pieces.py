"""A term as cubic pieces over equal segments, which C evaluates without knowing the term."""

from dataclasses import dataclass

import numpy as np
import torch

from tofcorr.correction.model import AGREEMENT
from tofcorr.error_terms.base import EVERYTHING, Axis, Domain, SignalTerm
from tofcorr.errors import ConfigError


@dataclass(frozen=True, kw_only=True)
class Pieces:
    """A function of one or two variables as cubics of the place within a segment.

    Attributes:
        axes: The variables, with the number of segments of these pieces.
        coefficients: Of 1, t, t^2, t^3, float32, shape (S, 4) for one axis; for two (S, R, 4, 4),
            the powers of the first variable first.
    """

    axes: tuple[Axis, ...]
    coefficients: np.ndarray


def pieces_of(term: SignalTerm, limits: Domain, most_pieces: int = 4096) -> Pieces:
    """Return the pieces of a term over the calibrated ranges, to a fifth of `AGREEMENT`.

    Each segment is halved until they follow the term, at most seven times: 2^7 pieces of a smooth
    function over the whole range resolve more than any calibration does.

    Args:
        term: The term.
        limits: Its ranges.
        most_pieces: With two variables, 4096 times 64 numbers of 4 bytes fill a quarter of a
            megabyte, which still stays in a second-level cache.

    Raises:
        ConfigError: So many pieces as there may be do not follow the term.
    """
    axes = term.axes() or _smooth(term, limits)
    for halvings in range(8):
        finer = tuple(axis._replace(segments=axis.segments * 2**halvings) for axis in axes)
        if np.prod([axis.segments for axis in finer]) > most_pieces and halvings:
            break
        found = _interpolated(term, finer)
        if _error(term, found) < AGREEMENT / 5:
            return found
    name = term.options.kind
    raise ConfigError(
        f"The term {name} changes too quickly for the c export: export torchscript, pt2 or onnx."
    )


def _smooth(term: SignalTerm, limits: Domain) -> tuple[Axis, ...]:
    distance = Axis("distance", *limits.radial_distance)
    return (
        (distance, Axis("amplitude", *(limits.amplitude or EVERYTHING)))
        if term.needs_amplitude
        else (distance,)
    )


def _interpolated(term: SignalTerm, axes: tuple[Axis, ...]) -> Pieces:
    """Return the cubics through the term's values at the Chebyshev points of every segment."""
    # A cubic through the Chebyshev points is within a factor of two of the best.
    points = 0.5 - 0.5 * np.cos(np.pi * (2 * np.arange(4) + 1) / 8)
    to_powers = np.linalg.inv(np.vander(points, 4, increasing=True))
    values = _values(term, axes, points)
    if len(axes) == 1:
        coefficients = np.einsum("pi,si->sp", to_powers, values)
    else:
        coefficients = np.einsum("pi,qj,srij->srpq", to_powers, to_powers, values)
    return Pieces(axes=axes, coefficients=coefficients.astype(np.float32))


def _error(term: SignalTerm, pieces: Pieces) -> float:
    """Return the largest error of the pieces at probes of every segment, metres."""
    places = np.linspace(0.0, 1.0, 13)  # More than three times the points that fix a cubic.
    powers = np.vander(places, 4, increasing=True)
    if len(pieces.axes) == 1:
        found = np.einsum("sp,ip->si", pieces.coefficients, powers)
    else:
        found = np.einsum("srpq,ip,jq->srij", pieces.coefficients, powers, powers)
    return float(np.abs(found - _values(term, pieces.axes, places)).max())


def _values(term: SignalTerm, axes: tuple[Axis, ...], places: np.ndarray) -> np.ndarray:
    """Return the term at places (P,) of each segment: shape (S, P), or (S, R, P, P)."""
    grids = []
    for axis in axes:
        step = (axis.high - axis.low) / axis.segments
        grids.append(axis.low + step * (np.arange(axis.segments)[:, None] + places))
    flat = [grid.ravel() for grid in grids]
    mesh = np.meshgrid(*flat, indexing="ij")
    given = {axis.variable: values for axis, values in zip(axes, mesh, strict=True)}
    if "log_amplitude" in given:
        given["amplitude"] = np.exp(given["log_amplitude"])
    distance = given.get("distance", np.ones_like(mesh[0]))
    amplitude = given.get("amplitude", np.ones_like(mesh[0]))
    with torch.no_grad():
        found = term(torch.from_numpy(distance), torch.from_numpy(amplitude)).numpy()
    if len(axes) == 1:
        return found.reshape(grids[0].shape)
    shape = (*grids[0].shape, *grids[1].shape)
    return found.reshape(shape).transpose(0, 2, 1, 3)
