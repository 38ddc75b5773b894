"""The smooth surface through one depth image, and what pixels deviate from it."""

from dataclasses import dataclass

import numpy as np

from tofcorr.geometry.camera import CameraIntrinsics
from tofcorr.geometry.rays import ray_directions
from tofcorr.spread import sigma_from_mad

# Powers of x and y of the smooth surface: a plane first, then what smooth errors add to it.
_POWERS = ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2), (3, 0), (2, 1), (1, 2), (0, 3))
_PLANE = 3
# Images with fewer valid pixels get no surface: ten coefficients would follow their noise. Chosen.
_LEAST_PIXELS = 100
# Pixels beyond this many robust standard deviations do not shape the surface; passes that find
# them. Six is never reached by normal noise of an image.
_CLIP = 6.0
_PASSES = 3


@dataclass(frozen=True, kw_only=True, eq=False)
class Surface:
    """A smooth surface fitted to a part of one image, all of shape (h, w).

    Attributes:
        residual: Measured minus smooth distance along the ray, metres; NaN where not valid.
        distance: Distance of the plane of the image along the ray, metres; also where no distance
            was measured. NaN where a ray does not meet it.
        cosine: Cosine of the angle of incidence on that plane; NaN likewise.
    """

    residual: np.ndarray
    distance: np.ndarray
    cosine: np.ndarray


class SurfaceFit:
    """Fits surfaces to the images of one camera.

    On a plane, 1/z is linear in x/z and y/z. A cubic in both follows the plane and every smooth
    error, so that noise, patterns and edges are left.

    Args:
        camera: The camera intrinsics.
    """

    def __init__(self, camera: CameraIntrinsics) -> None:
        self._rays = ray_directions(camera).numpy()
        self._z = self._rays[..., 2]
        x, y = (self._rays[..., axis] / self._z for axis in (0, 1))
        self._scale = max(float(np.abs(x).max()), float(np.abs(y).max()), 1e-6)
        x, y = x / self._scale, y / self._scale
        self._basis = np.stack([x**a * y**b for a, b in _POWERS])

    def __call__(
        self, distance: np.ndarray, valid: np.ndarray, place: tuple[slice, slice]
    ) -> Surface | None:
        """Fit the surface to a part of an image.

        Args:
            distance: Radial distances, shape (h, w), metres.
            valid: Which of them count, shape (h, w), bool.
            place: Where the part lies in the image.

        Returns:
            The surface; None if fewer than 100 pixels are valid.
        """
        if int(valid.sum()) < _LEAST_PIXELS:
            return None
        z, basis = self._z[place], np.ascontiguousarray(self._basis[:, *place])
        measured = np.where(valid, distance, 1.0)
        inverse = 1.0 / (measured * z)
        metres = measured**2 * z
        use = valid
        left = np.zeros_like(measured)
        for _ in range(_PASSES):
            smooth = _fitted(basis, inverse, metres, use)
            left = -(inverse - np.tensordot(smooth, basis, 1)) * metres
            around = np.abs(left - np.median(left[use]))
            limit = _CLIP * sigma_from_mad(float(np.median(around[use])))
            kept = valid & (around <= limit) if limit > 0 else use
            if kept.sum() < _LEAST_PIXELS or np.array_equal(kept, use):
                break
            use = kept
        plane = _fitted(basis[:_PLANE], inverse, metres, use)
        return Surface(residual=np.where(valid, left, np.nan), **self._geometry(plane, place))

    def _geometry(self, plane: np.ndarray, place: tuple[slice, slice]) -> dict[str, np.ndarray]:
        """Return distance and cosine of a plane 1/z = plane . (1, x, y)."""
        inverse = np.tensordot(plane, self._basis[:_PLANE, *place], 1)
        normal = np.array([plane[1] / self._scale, plane[2] / self._scale, plane[0]])
        cosine = self._rays[place] @ (normal / np.linalg.norm(normal))
        meets = inverse > 0
        distance = 1.0 / (np.where(meets, inverse, np.nan) * self._z[place])
        return {"distance": distance, "cosine": np.where(meets, cosine, np.nan)}


def _fitted(
    basis: np.ndarray, inverse: np.ndarray, metres: np.ndarray, use: np.ndarray
) -> np.ndarray:
    """Return the coefficients of the columns (K, h, w), weighted to metres."""
    columns = basis.reshape(len(basis), -1)
    weighted = columns * np.where(use, metres**2, 0.0).ravel()
    return np.linalg.solve(weighted @ columns.T, weighted @ inverse.ravel())
