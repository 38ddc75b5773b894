"""Whether the image has the shape that the header says: K, distortion, and radial or z.

A wrong camera or kind bends a wall in proportion to its distance, and by its tilt; errors of
distances do neither. All are estimated beside such errors, in one linear step from the alignment.
What that leaves is no error of a camera: wrong poses and planes show more clearly in it.
"""

from typing import NamedTuple

import numpy as np

from tofcorr.plausibility.linear_residuals import LinearResiduals, Solved
from tofcorr.plausibility.scene import Scene

# Fewest frames from which shape is told from the camera's errors. Chosen: 30 unknowns, three
# determined by each frame.
_FEWEST_FRAMES = 11


class Estimate(NamedTuple):
    """Values and their standard errors, both of shape (N,); an infinite one says nothing."""

    value: np.ndarray
    error: np.ndarray

    @property
    def size(self) -> float:
        """Root of the sum of squares of the values."""
        return float(np.linalg.norm(self.value))

    @property
    def size_error(self) -> float:
        """The same of the standard errors."""
        return float(np.linalg.norm(self.error))


class ImageShape(NamedTuple):
    """How far the image is from the shape that the header says.

    Attributes:
        focal: Relative error of the focal length: 0.1 if it should be 10 % longer.
        aspect: That of the horizontal focal length minus that of the vertical one.
        centre: How far the principal point should move to the right and down, relative to the
            focal length.
        corner: How far the distortion should move the corner of the image outward, relative to the
            focal length.
        bend: How far the corner should move to the right and down where the image's axes are bent,
            as by a wedge of glass or a tilted lens, relative to the focal length (thin prism
            distortion).
        kind: 0: the depth is of the kind declared; 1: it is of the other one.
        curvature: Of the target along two directions on it, and mixed, 1/m: its points lie that
            many metres off its plane at a metre from its middle.
        half_width: Half of what is seen of the target, metres.
        rms: What is left of each frame's distance to its plane, shape (F,), metres.
        planes_off: That of it which a plane makes, shape (F,), metres.
    """

    focal: Estimate
    aspect: Estimate
    centre: Estimate
    corner: Estimate
    bend: Estimate
    kind: Estimate
    curvature: Estimate
    half_width: float
    rms: np.ndarray
    planes_off: np.ndarray


def image_shape(
    scene: Scene, problem: LinearResiduals, rays: np.ndarray, declared: str
) -> ImageShape | None:
    """Estimate errors of the header beside the hand-eye and smooth errors of a camera.

    Each error of K and distortion is estimated as if it were the only one: seldom are there two.

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

    def alone(part: np.ndarray) -> Estimate:
        return _estimate(problem.with_columns(part).solved(), slice(-part.shape[-1], None))

    return ImageShape(
        focal=alone(shape[..., :1]),
        aspect=alone(shape[..., 1:2]),
        centre=alone(shape[..., 2:4]),
        corner=alone(shape[..., 4:5]),
        bend=alone(_bent_axes(problem, rays, declared)),
        kind=_estimate(found, slice(-1, None)),
        curvature=_estimate(found, slice(-9, -6)),
        half_width=half_width,
        rms=problem.frame_rms(found.left),
        planes_off=problem.frame_planes_off(found.left),
    )


def _estimate(found: Solved, chosen: slice) -> Estimate:
    # Rounding makes a variance negative where frames hardly determine anything: not known then.
    variance = np.diag(found.covariance)[chosen]
    return Estimate(found.unknowns[chosen], np.sqrt(np.where(variance >= 0, variance, np.inf)))


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
    """Return the derivatives by K, distortion and kind, shape (F, P, 6)."""
    x, y, square = _on_image(rays)
    # An outward move of the corner by one focal length.
    outward = square / max(float(square.max()), 1e-12) ** 1.5
    # A focal length longer by a share s makes (x, y) shorter by it; the depth stays as it was.
    one, zero = np.ones_like(x), np.zeros_like(x)
    moves = [(-x, -y), (-x / 2, y / 2), (-one, zero), (zero, -one), (-x * outward, -y * outward)]
    shape = [_moved(problem, rays, declared, move) for move in moves]
    other = -np.log(rays[..., 2]) if declared == "radial" else np.log(rays[..., 2])
    return np.stack([*shape, problem.cosine * problem.distance * other], axis=-1)


def _bent_axes(problem: LinearResiduals, rays: np.ndarray, declared: str) -> np.ndarray:
    """Return the derivatives by a bend of the image's axes, shape (F, P, 2)."""
    _, _, square = _on_image(rays)
    corner = square / max(float(square.max()), 1e-12)
    moves = [(-corner, np.zeros_like(corner)), (np.zeros_like(corner), -corner)]
    return np.stack([_moved(problem, rays, declared, move) for move in moves], axis=-1)


def _on_image(rays: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return x, y and x^2 + y^2 of rays (x, y, 1), shape (F, P) each."""
    x, y = rays[..., 0] / rays[..., 2], rays[..., 1] / rays[..., 2]
    return x, y, x * x + y * y


def _moved(
    problem: LinearResiduals, rays: np.ndarray, declared: str, move: tuple[np.ndarray, np.ndarray]
) -> np.ndarray:
    """Return what it does to the distances to the planes, (F, P), that rays (x, y, 1) move."""
    toward = np.stack([*move, np.zeros_like(move[0])], axis=-1) * rays[..., 2:3]
    if declared == "radial":
        toward = toward - rays * (toward * rays).sum(-1, keepdims=True)
    return np.einsum("fpa,fa->fp", toward, problem.normal) * problem.distance
