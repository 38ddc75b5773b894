"""The plane through the points of each frame alone, whatever share of them is garbage."""

from dataclasses import dataclass

import numpy as np

from tofcorr.spread import sigma_from_mad

# Triples of pixels tried for each frame. Chosen: with 40 % garbage, one of 40 triples is free of it
# with a probability of 1 - (1 - 0.6^3)^40 = 0.99994.
_TRIPLES = 40
# A pixel is on its frame's plane within this many robust standard deviations, or this distance in
# metres, whichever is larger. Chosen: errors of a camera bend a wall by a centimetre.
_SIGMAS, _LEAST_TOLERANCE = 4.0, 0.02
# Refinements of the plane by least squares over the pixels near it. Chosen.
_REFINEMENTS = 2
# Least standard deviation of a frame's rays across its two directions, radians; below it the
# direction of the plane is not known. Chosen: at 1 m it makes a base of 2 cm.
_LEAST_SPREAD = 0.02
# Fewest pixels of a plane that can be judged: three determine one.
_FEWEST_PIXELS = 6


@dataclass(frozen=True, eq=False)
class FramePlanes:
    """The plane of each frame in the camera frame, by its own points.

    Attributes:
        normal: Unit normals on the camera's side, shape (F, 3).
        offset: d of n . x + d = 0, shape (F,), metres.
        on_plane: Which pixels lie on it, shape (F, P), bool.
        flatness: Root mean square distance of these to it, shape (F,), metres.
        off_by: Distance along the ray of every pixel to it, shape (F, P), metres; NaN: no pixel.
        known: Whether a frame's pixels determine its plane, shape (F,), bool.
    """

    normal: np.ndarray
    offset: np.ndarray
    on_plane: np.ndarray
    flatness: np.ndarray
    off_by: np.ndarray
    known: np.ndarray


def frame_planes(rays: np.ndarray, distance: np.ndarray) -> FramePlanes:
    """Fit a plane to each frame: the best of some triples of pixels, then least squares near it.

    Args:
        rays: Unit rays, shape (F, P, 3).
        distance: Along the rays, shape (F, P), metres; NaN: not usable.
    """
    valid = np.isfinite(distance)
    points = rays * np.where(valid, distance, 0.0)[..., None]
    known = _determined(rays, valid)
    normal, offset = _best_triples(rays, points, distance, valid)
    on_plane = valid
    for _ in range(_REFINEMENTS):
        off_by = _off_by(rays, distance, normal, offset)
        spread = sigma_from_mad(_median(np.abs(off_by)))
        on_plane = np.abs(off_by) <= np.maximum(_SIGMAS * spread, _LEAST_TOLERANCE)[:, None]
        on_plane[~known] = valid[~known]
        normal, offset = _least_squares(points, on_plane)
    off_by = _off_by(rays, distance, normal, offset)
    count = np.maximum(on_plane.sum(1), 1)
    away = np.einsum("fpa,fa->fp", points, normal) + offset[:, None]
    flatness = np.sqrt(np.where(on_plane, away**2, 0.0).sum(1) / count)
    return FramePlanes(normal, offset, on_plane, flatness, off_by, known)


def _determined(rays: np.ndarray, valid: np.ndarray) -> np.ndarray:
    count = np.maximum(valid.sum(1), 1)
    mean = np.where(valid[..., None], rays, 0.0).sum(1) / count[:, None]
    centred = np.where(valid[..., None], rays - mean[:, None], 0.0)
    spread = np.linalg.eigvalsh(np.einsum("fpa,fpb->fab", centred, centred) / count[:, None, None])
    return (spread[:, 1] > _LEAST_SPREAD**2) & (valid.sum(1) >= _FEWEST_PIXELS)


def _best_triples(
    rays: np.ndarray, points: np.ndarray, distance: np.ndarray, valid: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the plane through three pixels, of those tried the one that most pixels agree with."""
    frames = np.arange(len(rays))
    places = np.random.default_rng(0).uniform(size=(len(rays), _TRIPLES, 3))
    order = np.argsort(~valid, axis=1, kind="stable")
    rank = (places * np.maximum(valid.sum(1), 1)[:, None, None]).astype(int)
    drawn = order[frames[:, None, None], rank]
    corners = points[frames[:, None, None], drawn]
    across = corners[:, :, 1:] - corners[:, :, :1]
    normal = np.cross(across[:, :, 0], across[:, :, 1])
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-12)
    offset = -(normal * corners[:, :, 0]).sum(-1)
    cosine = np.einsum("fta,fpa->ftp", normal, rays)
    cosine = np.where(np.abs(cosine) < 1e-6, 1e-6, cosine)
    error = np.abs(-offset[..., None] / cosine - distance[:, None])
    best = _median(error).argmin(1)
    return normal[frames, best], offset[frames, best]


def _off_by(
    rays: np.ndarray, distance: np.ndarray, normal: np.ndarray, offset: np.ndarray
) -> np.ndarray:
    cosine = np.einsum("fpa,fa->fp", rays, normal)
    cosine = np.where(np.abs(cosine) < 1e-6, 1e-6, cosine)
    return distance + offset[:, None] / cosine


def _least_squares(points: np.ndarray, chosen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    count = np.maximum(chosen.sum(1), 1)
    mean = np.where(chosen[..., None], points, 0.0).sum(1) / count[:, None]
    centred = np.where(chosen[..., None], points - mean[:, None], 0.0)
    normal = np.linalg.eigh(np.einsum("fpa,fpb->fab", centred, centred))[1][..., 0]
    # The camera is the origin; the normal points to its side.
    facing = np.where((normal * mean).sum(-1) > 0, -1.0, 1.0)
    normal = normal * facing[:, None]
    return normal, -(normal * mean).sum(-1)


def _median(values: np.ndarray) -> np.ndarray:
    """Return the median of the last axis without NaN; infinity where there is no value."""
    ordered = np.sort(values, axis=-1)  # NaN goes last.
    count = np.isfinite(values).sum(-1)
    middle = np.maximum((count - 1) // 2, 0)
    found = np.take_along_axis(ordered, middle[..., None], axis=-1)[..., 0]
    return np.where(count > 0, found, np.inf)
