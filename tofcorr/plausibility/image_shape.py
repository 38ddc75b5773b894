"""Whether the image has the shape that the header says: focal length, centre, and radial or z.

A wrong focal length or kind bends a wall in proportion to its distance, and by its tilt; errors of
a camera do neither. All are estimated beside such errors, in one linear step from the alignment.
What that leaves is no error of a camera: wrong poses and planes show more clearly in it.
"""

from typing import NamedTuple

import numpy as np

from tofcorr.plausibility.alignment import Alignment
from tofcorr.plausibility.scene import Scene

# Fewest frames from which shape is told from the camera's errors. Chosen: 24 unknowns, three
# determined by each frame.
_FEWEST_FRAMES = 10
# Knots of the error over the distance. Chosen: over 6 m, three periods of the circular error.
_KNOTS = 8
# Pixels further than this many typical distances from the plane are left out. Chosen.
_FARTHEST = 4.0
# Ridge relative to each unknown's own curvature. Chosen: it only decides what nothing determines.
_RIDGE = 1e-9


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
    scene: Scene,
    found: Alignment,
    rays: np.ndarray,
    distance: np.ndarray,
    used: np.ndarray,
    declared: str,
) -> ImageShape | None:
    """Estimate errors of focal length and kind beside the hand-eye and smooth errors of a camera.

    Args:
        scene: Poses and planes.
        found: Their alignment.
        rays: Unit rays, shape (F, P, 3).
        distance: Along them, shape (F, P), metres.
        used: Which pixels lie on their plane, shape (F, P).
        declared: `radial` or `z`.

    Returns:
        None where there are too few frames, or the hand-eye transform is fixed.
    """
    if not scene.moves or len(scene.poses) < _FEWEST_FRAMES:
        return None
    normal_tool, offset_tool = scene.planes_in_tool()
    rotation, place = found.hand_eye[:3, :3], found.hand_eye[:3, 3]
    normal = normal_tool @ rotation
    offset = normal_tool @ place + offset_tool
    d = np.where(used, distance, 1.0)
    cosine = np.einsum("fpa,fa->fp", rays, normal)
    residual = cosine * ((1 - found.slope) * d - found.constant) + offset[:, None]
    used = used & (np.abs(residual) < _FARTHEST * np.maximum(found.rms, found.misfit)[:, None])
    columns = _columns(rays, d, cosine, normal, normal_tool, declared)
    bent, half_width = _bent(scene, found.hand_eye, rays * d[..., None], used)
    columns = np.concatenate([bent, columns], axis=-1)
    weight = np.where(used, 1.0, 0.0) / np.maximum(found.rms, found.misfit)[:, None] ** 2
    return _solved(columns, residual, weight, half_width)


def _bent(
    scene: Scene, hand_eye: np.ndarray, points: np.ndarray, used: np.ndarray
) -> tuple[np.ndarray, float]:
    """Return s^2, t^2, st of the points' places on the target, (F, P, 3), and its half width."""
    camera = scene.poses @ hand_eye
    world = np.einsum("fab,fpb->fpa", camera[:, :3, :3], points) + camera[:, None, :3, 3]
    along = np.eye(3)[np.abs(scene.normal).mean(0).argmin()]
    first = np.cross(scene.normal, along)
    first /= np.maximum(np.linalg.norm(first, axis=1, keepdims=True), 1e-9)
    second = np.cross(scene.normal, first)
    s, t = (np.einsum("fpa,fa->fp", world, one) for one in (first, second))
    s, t = s - np.median(s[used]), t - np.median(t[used])
    half_width = float(np.quantile(np.hypot(s[used], t[used]), 0.9)) if used.any() else 0.0
    return np.stack([s * s, t * t, s * t], axis=-1), half_width


def _columns(
    rays: np.ndarray,
    d: np.ndarray,
    cosine: np.ndarray,
    normal: np.ndarray,
    normal_tool: np.ndarray,
    declared: str,
) -> np.ndarray:
    """Return the derivatives of the distance to the plane, shape (F, P, K); shape comes last."""
    x, y = rays[..., 0] / rays[..., 2], rays[..., 1] / rays[..., 2]
    points = rays * d[..., None]
    turned = np.cross(points, normal[:, None])
    moved = np.broadcast_to(normal_tool[:, None], points.shape)
    smooth = np.stack([x, y, x * x, y * y, x * y], axis=-1)
    errors = cosine[..., None] * np.concatenate([_over_distance(d), smooth], axis=-1)
    # A focal length longer by a share s makes (x, y) shorter by it; the depth stays as it was.
    one, zero = np.ones_like(x), np.zeros_like(x)
    moves = [(-x, -y, zero), (-one, zero, zero), (zero, -one, zero)]
    shape = []
    for move in moves:
        toward = np.stack(move, axis=-1) * rays[..., 2:3]
        if declared == "radial":
            toward = toward - rays * (toward * rays).sum(-1, keepdims=True)
        shape.append(np.einsum("fpa,fa->fp", toward, normal) * d)
    other = -np.log(rays[..., 2]) if declared == "radial" else np.log(rays[..., 2])
    kind = cosine * d * other
    return np.concatenate([turned, moved, errors, np.stack([*shape, kind], axis=-1)], axis=-1)


def _over_distance(d: np.ndarray) -> np.ndarray:
    """Return hat functions over the distance, which sum to one, shape (..., 8)."""
    low, high = d.min(), d.max()
    place = (d - low) / max(high - low, 1e-9) * (_KNOTS - 1)
    return np.maximum(1 - np.abs(place[..., None] - np.arange(_KNOTS)), 0.0)


def _solved(
    columns: np.ndarray, residual: np.ndarray, weight: np.ndarray, half_width: float
) -> ImageShape:
    """Solve the weighted least squares; standard errors treat each frame as one observation."""
    weighted = columns * weight[..., None]
    matrix = np.einsum("fpa,fpb->ab", weighted, columns, optimize=True)
    scale = 1 / np.sqrt(np.maximum(np.diag(matrix), 1e-30))
    matrix = matrix * scale * scale[:, None] + _RIDGE * np.eye(len(scale))
    vector = np.einsum("fpa,fp->a", weighted, residual) * scale
    inverse = np.linalg.inv(matrix)
    solution = -inverse @ vector
    left = residual + columns @ (solution * scale)
    scores = np.einsum("fpa,fp->fa", weighted, left) * scale
    covariance = inverse @ (scores.T @ scores) @ inverse
    # Rounding makes a variance negative where frames hardly determine anything: not known then.
    variance = np.diag(covariance)
    solution = solution * scale
    error = np.sqrt(np.where(variance >= 0, variance, np.inf)) * scale
    count = np.maximum((weight > 0).sum(1), 1)
    return ImageShape(
        focal=float(solution[-4]),
        focal_se=float(error[-4]),
        kind=float(solution[-1]),
        kind_se=float(error[-1]),
        centre=solution[-3:-1],
        centre_se=error[-3:-1],
        curvature=solution[:3],
        curvature_se=error[:3],
        half_width=half_width,
        rms=np.sqrt(np.where(weight > 0, left**2, 0.0).sum(1) / count),
    )
