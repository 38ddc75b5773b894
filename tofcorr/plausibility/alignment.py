"""The hand-eye transform under which measured points lie best on the recorded planes.

Robust over frames: a few wrong poses do not move it. A constant error of the distance and one in
proportion to it are estimated as well, since every camera has them.
"""

from dataclasses import dataclass

import numpy as np

from tofcorr.plausibility.scene import Scene

# Steps of the solver, each with new weights of the frames. Chosen: quadratic convergence from the
# closed form takes five, the weights a few more.
_STEPS = 12
# Standard deviation of one frame's misfit, metres; it only scales the priors below. Chosen.
_SCALE = 0.01
# Prior standard deviation of the constant error, metres, and of each step of the hand-eye in
# directions that the frames leave open, metres and radians. Chosen: large.
_CONSTANT_PRIOR, _STEP_PRIOR = 0.05, 1.0
# Prior standard deviation of the error in proportion to the distance, without unit. Chosen: clocks
# are right to a percent, and no unit may hide in it.
_SLOPE_PRIOR = 0.01
# Cauchy's tuning constant, in standard deviations. 95 % efficiency on normal noise (Holland and
# Welsch 1977).
_CAUCHY = 2.385
# Random subsets of frames tried as a start beside all frames, and frames in each. Chosen: with a
# third of the poses wrong, one of 12 subsets is right with a probability of 0.93.
_SUBSETS, _SUBSET_SIZE = 12, 4
# Constant error from which it counts as odd, metres, and the share of the rest that does. Chosen:
# cameras leave the factory within a few centimetres.
_USUAL_CONSTANT, _OFFSET_SHARE = 0.1, 0.1
# Least misfit that weights look at, metres. Chosen.
_LEAST = 1e-4


@dataclass(frozen=True, eq=False)
class Alignment:
    """A hand-eye transform, and how far frames are from their planes under it.

    Attributes:
        hand_eye: tool_from_camera, shape (4, 4), metres.
        constant: Constant error of the distance, metres.
        slope: Error in proportion to the distance, without unit.
        rms: Root mean square distance of each frame's points to its plane, shape (F,), metres.
        angle: Between a frame's own plane and the recorded one, shape (F,), radians; NaN: unknown.
    """

    hand_eye: np.ndarray
    constant: float
    slope: float
    rms: np.ndarray
    angle: np.ndarray

    @property
    def misfit(self) -> float:
        """Median over the frames of their distance to their planes, metres."""
        return float(np.median(self.rms)) if len(self.rms) else 0.0

    @property
    def badness(self) -> float:
        """Misfit, and a tenth of what the constant error exceeds 100 mm by, metres.

        Points of another surface may lie parallel to the target: then only the constant shows it.
        """
        return self.misfit + _OFFSET_SHARE * max(abs(self.constant) - _USUAL_CONSTANT, 0.0)

    @property
    def typical_angle(self) -> float:
        """Median over the frames of the angle between the two planes, radians; NaN: unknown."""
        return (
            float(np.median(known)) if len(known := self.angle[~np.isnan(self.angle)]) else np.nan
        )


def align(scene: Scene) -> Alignment:
    """Return the best hand-eye transform; without a robot it is the identity."""
    if not scene.moves:
        return _refined(scene, np.eye(4), free=False)
    found = [_refined(scene, start, free=True) for start in _starts(scene)]
    return min(found, key=lambda one: one.misfit)


def judged(scene: Scene, hand_eye: np.ndarray, constant: float, slope: float) -> Alignment:
    """Return how far frames are from their planes under a given hand-eye transform."""
    residual, normal, _ = _linear(scene, hand_eye, constant, slope)
    square = np.einsum("fa,fab,fb->f", residual, scene.moments, residual)
    cosine = (scene.own_normal * normal).sum(1).clip(-1, 1)
    angle = np.where(scene.known, np.arccos(cosine), np.nan)
    return Alignment(hand_eye, constant, slope, np.sqrt(np.maximum(square, 0.0)), angle)


def _linear(
    scene: Scene, hand_eye: np.ndarray, constant: float, slope: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the residual as a form on q (F, 7), and the normals in camera and tool (F, 3)."""
    normal_tool, offset_tool = scene.planes_in_tool()
    normal = normal_tool @ hand_eye[:3, :3]
    offset = normal_tool @ hand_eye[:3, 3] + offset_tool
    return (
        np.concatenate([(1 - slope) * normal, offset[:, None], -constant * normal], axis=1),
        normal,
        normal_tool,
    )


def _refined(scene: Scene, start: np.ndarray, *, free: bool) -> Alignment:
    found = judged(scene, start, 0.0, 0.0)
    for _ in range(_STEPS):
        found = _step(scene, found, free=free)
    return found


def _step(scene: Scene, at: Alignment, *, free: bool) -> Alignment:
    """Take one Gauss-Newton step with the frames weighted by their misfit."""
    residual, normal, normal_tool = _linear(scene, at.hand_eye, at.constant, at.slope)
    scale = max(at.misfit, _LEAST)
    weight = 1 / (1 + (at.rms / (_CAUCHY * scale)) ** 2) / _SCALE**2
    # Rows: rotation (3), translation (3), constant, slope; columns: q.
    change = np.zeros((len(normal), 8, 7))
    across = _crossed(normal)
    change[:, 0:3, 0:3] = (1 - at.slope) * across
    change[:, 0:3, 4:7] = -at.constant * across
    change[:, 3:6, 3] = normal_tool
    change[:, 6, 4:7] = -normal
    change[:, 7, 0:3] = -normal
    if not free:
        change[:, :6] = 0.0
    product = change @ scene.moments
    hessian = np.einsum("f,fab,fcb->ac", weight, product, change)
    gradient = np.einsum("f,fab,fb->a", weight, product, residual)
    prior = np.full(8, _STEP_PRIOR**-2)
    prior[6:] = _CONSTANT_PRIOR**-2, _SLOPE_PRIOR**-2
    gradient[6:] += prior[6:] * [at.constant, at.slope]
    step = -np.linalg.solve(hessian + np.diag(prior), gradient)
    moved = at.hand_eye.copy()
    moved[:3, :3] = at.hand_eye[:3, :3] @ _rotation(step[:3])
    moved[:3, 3] += step[3:6]
    return judged(scene, moved, at.constant + step[6], at.slope + step[7])


def _starts(scene: Scene) -> list[np.ndarray]:
    """Return the recorded guess, and closed forms from all frames and from some subsets."""
    if not scene.known.any():
        return [scene.guess, *_single_ray_start(scene)]
    known = np.flatnonzero(scene.known)
    normal_tool, _ = scene.planes_in_tool()
    generator = np.random.default_rng(0)
    subsets = [known]
    if len(known) > _SUBSET_SIZE:
        subsets += [generator.choice(known, _SUBSET_SIZE, replace=False) for _ in range(_SUBSETS)]
    rotations = [_procrustes(normal_tool[one], scene.own_normal[one]) for one in subsets]
    deviation = [
        np.median(np.abs(normal_tool[known] @ r - scene.own_normal[known]).sum(1))
        for r in rotations
    ]
    best = rotations[1:][int(np.argmin(deviation[1:]))] if len(rotations) > 1 else rotations[0]
    return [
        scene.guess,
        *(_with_translation(scene, rotation) for rotation in (rotations[0], best)),
    ]


def _procrustes(to: np.ndarray, of: np.ndarray) -> np.ndarray:
    """Return the rotation that turns directions `of` (N, 3) into `to` (N, 3)."""
    left, _, right = np.linalg.svd(to.T @ of)
    return left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right


def _with_translation(scene: Scene, rotation: np.ndarray) -> np.ndarray:
    """Return the transform of a rotation with the translation that fits most frames."""
    start = np.eye(4)
    start[:3, :3] = rotation
    residual, _, normal_tool = _linear(scene, start, 0.0, 0.0)
    mean = np.einsum("fa,fa->f", residual, scene.moments[:, 3])
    weight = np.ones(len(mean))
    for _ in range(5):
        matrix = (normal_tool * weight[:, None]).T @ normal_tool + 1e-6 * np.eye(3)
        start[:3, 3] = -np.linalg.solve(matrix, (normal_tool * weight[:, None]).T @ mean)
        left = np.abs(mean + normal_tool @ start[:3, 3])
        weight = 1 / np.maximum(left, max(float(np.median(left)), _LEAST))
    return start


def _single_ray_start(scene: Scene) -> list[np.ndarray]:
    """Return a start where every frame has one direction only: linear in ray and translation."""
    normal_tool, offset_tool = scene.planes_in_tool()
    mean = scene.moments[:, 3]
    distance = np.linalg.norm(mean[:, :3], axis=1)
    ray = mean[0, 4:7] / max(np.linalg.norm(mean[0, 4:7]), 1e-12)
    matrix = np.concatenate([normal_tool * distance[:, None], normal_tool], axis=1)
    solved = np.linalg.lstsq(matrix, -offset_tool, rcond=1e-9)[0]
    start = np.eye(4)
    start[:3, :3] = _procrustes(solved[None, :3], ray[None])
    start[:3, 3] = solved[3:]
    return [start]


def _crossed(vector: np.ndarray) -> np.ndarray:
    """Return the matrices M (F, 3, 3) with M x = x cross v, for v of shape (F, 3)."""
    zero = np.zeros(len(vector))
    x, y, z = vector.T
    return np.stack(
        [
            np.stack([zero, z, -y], -1),
            np.stack([-z, zero, x], -1),
            np.stack([y, -x, zero], -1),
        ],
        axis=1,
    )


def _rotation(vector: np.ndarray) -> np.ndarray:
    """Return the rotation of a rotation vector (3,), radians (Rodrigues)."""
    angle = float(np.linalg.norm(vector))
    if angle < 1e-12:
        return np.eye(3)
    x, y, z = vector / angle
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k
