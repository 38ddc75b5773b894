"""Whether the image has the shape that the header says: focal length, centre, and radial or z.

A wrong focal length or kind bends a wall in proportion to its distance, and by its tilt; errors of
a camera do neither. All are estimated beside such errors, in one linear step from the alignment.
What that leaves is no error of a camera: wrong poses and planes show more clearly in it.
"""

from typing import NamedTuple

import numpy as np

from tofcorr.plausibility.linear_residuals import LinearResiduals
from tofcorr.plausibility.scene import Scene

# Fewest frames from which shape is told from the camera's errors. Chosen: 24 unknowns, three
# determined by each frame.
_FEWEST_FRAMES = 10


class ImageShape(NamedTuple):
    """How far the image is from the shape that the header says.

    Attributes:
        focal: Relative error of the focal length: 0.1 if it should be 10 % longer.
        focal_se: Its standard error, from the frames.
        kind: 0: the depth is of the kind declared; 1: it is of the other one.
        kind_se: Its standard error.
        centre: How far the principal point should move to the right and down, relative to the
            focal length, shape (2,).
        centre_se: Its standard errors, shape (2,).
        rms: What is left of each frame's distance to its plane, shape (F,), metres.
        curvature: Of the target along two directions on it, and mixed, shape (3,), 1/m: its points
            lie that many metres off its plane at a metre from its middle.
        curvature_se: Its standard errors, shape (3,).
        half_width: Half of what is seen of the target, metres.
    """

    focal: float
    focal_se: float
    kind: float
    kind_se: float
    centre: np.ndarray
    centre_se: np.ndarray
    rms: np.ndarray
    curvature: np.ndarray
    curvature_se: np.ndarray
    half_width: float


def image_shape(
    scene: Scene, problem: LinearResiduals, rays: np.ndarray, declared: str
) -> ImageShape | None:
    """Estimate errors of focal length and kind beside the hand-eye and smooth errors of a camera.

    Args:
        scene: Poses and planes.
        problem: The residuals near their alignment.
        rays: Unit rays, shape (F, P, 3).
        declared: `radial` or `z`.

    Returns:
        None where there are too few frames, or the hand-eye transform is fixed.
    """
    if not scene.moves or len(scene.poses) < _FEWEST_FRAMES:
        return None
    bent, half_width = _bent(scene, problem)
    shape = _shape(problem, rays, declared)
    found = problem.with_columns(bent).with_columns(shape).solved()
    # Rounding makes a variance negative where frames hardly determine anything: not known then.
    variance = np.diag(found.covariance)
    error = np.sqrt(np.where(variance >= 0, variance, np.inf))
    return ImageShape(
        focal=float(found.unknowns[-4]),
        focal_se=float(error[-4]),
        kind=float(found.unknowns[-1]),
        kind_se=float(error[-1]),
        centre=found.unknowns[-3:-1],
        centre_se=error[-3:-1],
        curvature=found.unknowns[-7:-4],
        curvature_se=error[-7:-4],
        half_width=half_width,
        rms=problem.frame_rms(found.left),
    )


def _bent(scene: Scene, problem: LinearResiduals) -> tuple[np.ndarray, float]:
    """Return s^2, t^2, st of the points' places on the target, (F, P, 3), and its half width."""
    world, used = problem.world, problem.used
    along = np.eye(3)[np.abs(scene.normal).mean(0).argmin()]
    first = np.cross(scene.normal, along)
    first /= np.maximum(np.linalg.norm(first, axis=1, keepdims=True), 1e-9)
    second = np.cross(scene.normal, first)
    s, t = (np.einsum("fpa,fa->fp", world, one) for one in (first, second))
    s, t = s - np.median(s[used]), t - np.median(t[used])
    half_width = float(np.quantile(np.hypot(s[used], t[used]), 0.9)) if used.any() else 0.0
    return np.stack([s * s, t * t, s * t], axis=-1), half_width


def _shape(problem: LinearResiduals, rays: np.ndarray, declared: str) -> np.ndarray:
    """Return the derivatives by focal length, principal point and kind, shape (F, P, 4)."""
    x, y = rays[..., 0] / rays[..., 2], rays[..., 1] / rays[..., 2]
    # A focal length longer by a share s makes (x, y) shorter by it; the depth stays as it was.
    one, zero = np.ones_like(x), np.zeros_like(x)
    moves = [(-x, -y, zero), (-one, zero, zero), (zero, -one, zero)]
    shape = []
    for move in moves:
        toward = np.stack(move, axis=-1) * rays[..., 2:3]
        if declared == "radial":
            toward = toward - rays * (toward * rays).sum(-1, keepdims=True)
        shape.append(np.einsum("fpa,fa->fp", toward, problem.normal) * problem.distance)
    other = -np.log(rays[..., 2]) if declared == "radial" else np.log(rays[..., 2])
    return np.stack([*shape, problem.cosine * problem.distance * other], axis=-1)
