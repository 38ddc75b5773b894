"""Distances of points to their planes, linear in what a camera's calibration leaves open.

One linear step from the alignment: the hand-eye transform, errors over the distance and the
amplitude, and smooth errors over the image. Whoever looks for something else puts its own columns
beside these.
"""

from typing import NamedTuple, Self

import numpy as np

from tofcorr.plausibility.alignment import Alignment
from tofcorr.plausibility.scene import Scene

# Knots of the error over the distance. Chosen: over 6 m, three periods of the circular error.
_KNOTS = 8
# Share of the pixels below and up to the ends of the knots. Chosen: few pixels of a steep wall are
# several times as far as all others, and would take most of the knots.
_MOST = (0.002, 0.998)
# Unknowns of the hand-eye transform. Three turns and three shifts.
_RIGID = 6
# Pixels further than this many typical distances from the plane are left out. Chosen.
_FARTHEST = 4.0
# Cosine of the angle of incidence below which the distance to the plane is not computed, no unit: a
# ray along the wall meets it anywhere. Chosen: 87 degrees.
_GRAZING = 0.05
# Unknowns that one frame determines: two tilts and the offset of its plane.
_OF_A_FRAME = 3
# Ridge relative to each unknown's own curvature. Chosen: it only decides what nothing determines.
_RIDGE = 1e-9


class Solved(NamedTuple):
    """The least squares solution of K unknowns.

    Attributes:
        unknowns: Shape (K,).
        covariance: Of these, shape (K, K). Each frame counts as one observation; infinite where
            there are hardly more frames than determine the unknowns.
        left: What is left of the residuals, shape (F, P), metres.
    """

    unknowns: np.ndarray
    covariance: np.ndarray
    left: np.ndarray


class LinearResiduals(NamedTuple):
    """F frames of P pixels, K unknowns.

    Attributes:
        residual: Distance of each point to its plane, shape (F, P), metres.
        columns: Its derivatives by the unknowns, shape (F, P, K).
        weight: Of each pixel, shape (F, P), 1 / m^2; zero: not used.
        cosine: Change of the residual with the distance along the ray, shape (F, P).
        distance: Along the rays to the planes, as the camera should measure it there, shape (F, P),
            metres: what is measured, without its noise; 1 where no pixel is used.
        normal: Of the planes in the camera frame, shape (F, 3).
        world: Where the points should be in the world, shape (F, P, 3), metres.
    """

    residual: np.ndarray
    columns: np.ndarray
    weight: np.ndarray
    cosine: np.ndarray
    distance: np.ndarray
    normal: np.ndarray
    world: np.ndarray

    @property
    def used(self) -> np.ndarray:
        """Which pixels are used, shape (F, P), bool."""
        return self.weight > 0

    @property
    def rigid(self) -> np.ndarray:
        """The columns of the hand-eye transform: turns and shifts, shape (F, P, 6)."""
        return self.columns[..., :_RIGID]

    @property
    def beside_distance(self) -> np.ndarray:
        """Those of errors of a camera that do not depend on the distance, shape (F, P, K)."""
        return self.columns[..., _RIGID + _KNOTS :]

    def with_columns(self, columns: np.ndarray) -> Self:
        """Return the problem with further unknowns, after those that it has."""
        return self._replace(columns=np.concatenate([self.columns, columns], axis=-1))

    def with_errors_of_frames(self, values: np.ndarray) -> Self:
        """Return the problem with errors of the distance in proportion to values (F, K)."""
        return self.with_columns(self.cosine[..., None] * values[:, None])

    def frame_rms(self, left: np.ndarray) -> np.ndarray:
        """Return the root mean square of what is left (F, P) of each frame, shape (F,), metres."""
        count = np.maximum(self.used.sum(1), 1)
        return np.sqrt(np.where(self.used, left**2, 0.0).sum(1) / count)

    def plane_directions(self) -> np.ndarray:
        """Return what offset and tilts of a frame's plane do, orthonormal over its pixels.

        Shape (F, P, 3).
        """
        moved = np.where(self.used[..., None], self.rigid, 0.0)
        return np.linalg.svd(moved, full_matrices=False)[0][..., :_OF_A_FRAME]

    def frame_planes_off(self, left: np.ndarray) -> np.ndarray:
        """Return how far the planes of what is left (F, P) are from flat and zero, (F,), metres.

        Root mean square over a frame's pixels: what a wrong pose or plane does, and no error of
        single pixels.
        """
        count = np.maximum(self.used.sum(1), 1)
        planes = np.einsum("fpa,fp->fa", self.plane_directions(), left)
        return np.linalg.norm(planes, axis=1) / np.sqrt(count)

    def solved(self) -> Solved:
        """Solve the weighted least squares."""
        weighted = self.columns * self.weight[..., None]
        matrix = np.einsum("fpa,fpb->ab", weighted, self.columns, optimize=True)
        scale = 1 / np.sqrt(np.maximum(np.diag(matrix), 1e-30))
        matrix = matrix * scale * scale[:, None] + _RIDGE * np.eye(len(scale))
        inverse = np.linalg.inv(matrix)
        unknowns = -inverse @ (np.einsum("fpa,fp->a", weighted, self.residual) * scale) * scale
        left = self.residual + self.columns @ unknowns
        scores = np.einsum("fpa,fp->fa", weighted, left) * scale
        # The residuals are smaller than the errors, by the unknowns that were fitted to them.
        count = len(self.residual)
        freedom = count - len(unknowns) / _OF_A_FRAME
        covariance = np.full_like(matrix, np.inf)
        if freedom > 0:
            covariance = count / freedom * inverse @ (scores.T @ scores) @ inverse
        return Solved(unknowns, covariance * scale * scale[:, None], left)


def linear_residuals(
    scene: Scene,
    found: Alignment,
    rays: np.ndarray,
    distance: np.ndarray,
    used: np.ndarray,
    further: np.ndarray,
) -> LinearResiduals:
    """Return the residuals near an alignment.

    Args:
        scene: Poses and planes.
        found: Their alignment.
        rays: Unit rays, shape (F, P, 3).
        distance: Along them, shape (F, P), metres.
        used: Which pixels lie on their plane, shape (F, P).
        further: What errors of the distance may depend on besides distance and place, (F, P, K).
    """
    normal_tool, offset_tool = scene.planes_in_tool()
    normal = normal_tool @ found.hand_eye[:3, :3]
    offset = normal_tool @ found.hand_eye[:3, 3] + offset_tool
    d = np.where(used, distance, 1.0)
    cosine = np.einsum("fpa,fa->fp", rays, normal)
    residual = cosine * ((1 - found.slope) * d - found.constant) + offset[:, None]
    typical = np.maximum(found.rms, found.misfit)[:, None]
    used = used & (np.abs(residual) < _FARTHEST * typical)
    # Errors are looked for over the distance to the plane, not over the one measured: that has the
    # noise of the residual, which a mixture of columns would explain by what else tells distance.
    # So are places: with that noise, the square of a point's place would follow its residual, and
    # every wall would look bent.
    seen = used & (np.abs(cosine) > _GRAZING)
    d = d - np.where(seen, residual / ((1 - found.slope) * np.where(seen, cosine, 1.0)), 0.0)
    x, y = rays[..., 0] / rays[..., 2], rays[..., 1] / rays[..., 2]
    smooth = np.stack([x, y, x * x, y * y, x * y], axis=-1)
    errors = cosine[..., None] * np.concatenate([_over_distance(d, used), smooth, further], axis=-1)
    points = rays * d[..., None]
    turned = np.cross(points, normal[:, None])
    moved = np.broadcast_to(normal_tool[:, None], points.shape)
    camera = scene.poses @ found.hand_eye
    return LinearResiduals(
        residual=residual,
        columns=np.concatenate([turned, moved, errors], axis=-1),
        weight=np.where(used, 1.0, 0.0) / typical**2,
        cosine=cosine,
        distance=d,
        normal=normal,
        world=np.einsum("fab,fpb->fpa", camera[:, :3, :3], points) + camera[:, None, :3, 3],
    )


def _over_distance(d: np.ndarray, used: np.ndarray) -> np.ndarray:
    """Return hat functions over the distance, which sum to one, shape (..., 8)."""
    low, high = np.quantile(d[used], _MOST) if used.any() else (0.0, 1.0)
    place = ((d - low) / max(high - low, 1e-9)).clip(0, 1) * (_KNOTS - 1)
    return np.maximum(1 - np.abs(place[..., None] - np.arange(_KNOTS)), 0.0)
