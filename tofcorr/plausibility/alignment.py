"""The hand-eye transform under which measured points lie best on the recorded planes.

Robust over frames: a few wrong poses do not move it. A constant error of the distance and one in
proportion to it are estimated as well, since every camera has them. Where nobody measured the
planes, every wall is estimated with the hand-eye.
"""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from scipy.spatial.transform import Rotation

TINY = float(np.finfo(np.float64).tiny)
"""What a divisor is at the least."""
# Prior standard deviations of a step of the hand-eye in directions that the frames leave open,
# radians and metres (large), of the constant error, metres (large), and of the error in proportion
# to the distance (clocks are right to a percent, and no unit may hide in it). Chosen.
_PRIOR = np.array([1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 0.05, 0.01])
# Standard deviation of one frame's misfit, metres; it only scales the priors. And the least misfit
# that weights look at, metres. Chosen.
_SCALE, _LEAST = 0.01, 1e-4
# Cauchy's tuning constant, in standard deviations. 95 % efficiency on normal noise (Holland and
# Welsch 1977).
_CAUCHY = 2.385


@dataclass(frozen=True, eq=False)
class Scene:
    """What a recording claims: poses, planes and the P points of each of F frames.

    Attributes:
        poses: world_from_tool, shape (F, 4, 4), metres.
        normal: Of the planes in the world, shape (F, 3).
        offset: Of the planes, shape (F,), metres.
        rays: Unit rays, shape (F, P, 3).
        distance: Along the rays, shape (F, P), metres; NaN: not usable.
        own_normal: Of the plane through the frame's own points, on the camera's side, in the camera
            frame, shape (F, 3).
        known: Whether a frame's pixels determine that plane, shape (F,), bool.
        on_plane: Which pixels lie on it, shape (F, P), bool; where it is not known, all that are
            usable.
        off_by: Distance along the ray of every pixel to it, shape (F, P), metres; NaN: no pixel.
        flatness: Root mean square distance of the pixels on it to it, shape (F,), metres.
        moments: Mean of q q^T over these pixels with q = (point, 1, ray) in the camera frame, shape
            (F, 7, 7).
        moves: Whether a robot moves the camera; without one the hand-eye is the identity.
        guess: The recorded tool_from_camera, shape (4, 4).
    """

    poses: np.ndarray
    normal: np.ndarray
    offset: np.ndarray
    rays: np.ndarray
    distance: np.ndarray
    own_normal: np.ndarray
    known: np.ndarray
    on_plane: np.ndarray
    off_by: np.ndarray
    flatness: np.ndarray
    moments: np.ndarray
    moves: bool
    guess: np.ndarray

    def planes_in_tool(self) -> tuple[np.ndarray, np.ndarray]:
        """Return normals (F, 3) and offsets (F,) of the planes in the tool frame."""
        rotation, place = self.poses[:, :3, :3], self.poses[:, :3, 3]
        normal = np.einsum("fba,fb->fa", rotation, self.normal)
        return normal, (self.normal * place).sum(1) + self.offset

    def some(self, chosen: np.ndarray) -> Self:
        """Return the scene of some frames, by index or by mask."""
        whole = ("moves", "guess")
        parts = {name: all_[chosen] for name, all_ in vars(self).items() if name not in whole}
        return replace(self, **parts)


def distinct(rows: np.ndarray) -> np.ndarray:
    """Return indices of the distinct ones of rows (F, ...), rising: the first of each.

    Rows within 1e-5 are one: of poses, a tenth of what robots repeat to, metres and entries of the
    rotation.
    """
    rounded = np.round(rows.reshape(len(rows), -1), 5)
    return np.sort(np.unique(rounded, axis=0, return_index=True)[1])


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
        Cameras leave the factory within a few centimetres.
        """
        return self.misfit + max(abs(self.constant) - 0.1, 0.0) / 10

    @property
    def typical_angle(self) -> float:
        """Median over the frames of the angle between the two planes, radians; NaN: unknown."""
        known = self.angle[~np.isnan(self.angle)]
        return float(np.median(known)) if len(known) else np.nan


def align(scene: Scene) -> Alignment:
    """Return the best hand-eye transform; without a robot it is the identity."""
    starts = _starts(scene) if scene.moves else [np.eye(4)]
    return min((_refined(scene, start) for start in starts), key=lambda one: one.misfit)


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
    in_tool, offset = scene.planes_in_tool()
    normal = in_tool @ hand_eye[:3, :3]
    offset = in_tool @ hand_eye[:3, 3] + offset
    parts = [(1 - slope) * normal, offset[:, None], -constant * normal]
    return np.concatenate(parts, axis=1), normal, in_tool


def _refined(scene: Scene, start: np.ndarray) -> Alignment:
    """Take Gauss-Newton steps with the frames weighted by their misfit."""
    found = judged(scene, start, 0.0, 0.0)
    # Quadratic convergence from the closed form takes five, the weights a few more.
    for _ in range(12):
        found = _step(scene, found)
    return found


def _step(scene: Scene, at: Alignment) -> Alignment:
    residual, normal, in_tool = _linear(scene, at.hand_eye, at.constant, at.slope)
    scale = max(at.misfit, _LEAST)
    weight = 1 / (1 + (at.rms / (_CAUCHY * scale)) ** 2) / _SCALE**2
    # Rows: rotation (3), translation (3), constant, slope; columns: q.
    change = np.zeros((len(normal), 8, 7))
    if scene.moves:
        across = np.cross(np.eye(3), normal[:, None]).swapaxes(1, 2)
        change[:, 0:3, 0:3] = (1 - at.slope) * across
        change[:, 0:3, 4:7] = -at.constant * across
        change[:, 3:6, 3] = in_tool
    change[:, 6, 4:7] = change[:, 7, 0:3] = -normal
    product = change @ scene.moments
    hessian = np.einsum("f,fab,fcb->ac", weight, product, change)
    gradient = np.einsum("f,fab,fb->a", weight, product, residual)
    prior = _PRIOR**-2.0
    gradient[6:] += prior[6:] * [at.constant, at.slope]
    step = -np.linalg.solve(hessian + np.diag(prior), gradient)
    moved = at.hand_eye.copy()
    moved[:3, :3] = at.hand_eye[:3, :3] @ Rotation.from_rotvec(step[:3]).as_matrix()
    moved[:3, 3] += step[3:6]
    return judged(scene, moved, at.constant + step[6], at.slope + step[7])


def _starts(scene: Scene, subsets: int = 12, size: int = 4) -> list[np.ndarray]:
    """Return the recorded guess, and closed forms from all frames and from the best of some.

    With a third of the poses wrong, one of 12 subsets of 4 is right with a probability of 0.93.
    """
    if not scene.known.any():
        return [scene.guess, _single_ray_start(scene)]
    known = np.flatnonzero(scene.known)
    in_tool, own = scene.planes_in_tool()[0][known], scene.own_normal[known]
    rotations = [_procrustes(in_tool, own)]
    if len(known) > size:
        generator = np.random.default_rng(0)
        drawn = [generator.choice(len(known), size, replace=False) for _ in range(subsets)]
        tried = [_procrustes(in_tool[one], own[one]) for one in drawn]
        off = [np.median(np.abs(in_tool @ one - own).sum(1)) for one in tried]
        rotations.append(tried[int(np.argmin(off))])
    starts = np.tile(np.eye(4), (len(rotations), 1, 1))
    starts[:, :3, :3] = rotations
    return [scene.guess, *starts]


def _procrustes(to: np.ndarray, of: np.ndarray) -> np.ndarray:
    """Return the rotation that turns directions `of` (N, 3) into `to` (N, 3)."""
    left, _, right = np.linalg.svd(to.T @ of)
    return left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right


def _single_ray_start(scene: Scene) -> np.ndarray:
    """Return a start where every frame has one direction only: linear in ray and translation."""
    in_tool, offset_tool = scene.planes_in_tool()
    mean = scene.moments[:, 3]
    distance = np.linalg.norm(mean[:, :3], axis=1)
    ray = mean[0, 4:7] / max(np.linalg.norm(mean[0, 4:7]), TINY)
    matrix = np.concatenate([in_tool * distance[:, None], in_tool], axis=1)
    solved = np.linalg.lstsq(matrix, -offset_tool, rcond=1e-9)[0]
    start = np.eye(4)
    start[:3, :3] = _procrustes(solved[None, :3], ray[None])
    start[:3, 3] = solved[3:]
    return start


def walls_of(scene: Scene) -> np.ndarray:
    """Return a number for each frame's wall, shape (F,): frames of one recorded plane share it.

    Planes are one wall if normal and offset agree to four decimals; as in fit.
    """
    planes = np.round(np.column_stack([scene.normal, scene.offset]), 4)
    return np.unique(planes, axis=0, return_inverse=True)[1].reshape(-1)


def align_with_free_walls(scene: Scene, fewest: int = 4) -> Alignment | None:
    """Return the alignment on walls estimated with it; None where the frames do not allow it.

    A wall needs `fewest` frames: it has three unknowns.
    """
    wall = walls_of(scene)
    if not scene.moves or np.bincount(wall).min() < fewest or not scene.known.all():
        return None
    starts = [scene]
    normal = _directions(scene, wall)
    if normal is not None:
        # Each wall at the middle of its frames' points, the hand-eye guessed as the identity.
        places = _world_moments(scene, np.eye(4), 0.0, 0.0)[:, 3, :3]
        offset = np.array([-places[wall == w].mean(0) @ m for w, m in enumerate(normal)])
        starts.append(replace(scene, normal=normal[wall], offset=offset[wall]))
    return min((_alternated(start, wall) for start in starts), key=lambda one: one.misfit)


def _alternated(scene: Scene, wall: np.ndarray) -> Alignment:
    """Take walls from the alignment and the alignment from the walls, in turn.

    Beyond eight rounds, the misfit of walls 40 degrees off falls by less than a tenth.
    """
    found = align(scene)
    for _ in range(8):
        scene = _with_walls(scene, found, wall)
        found = align(replace(scene, guess=found.hand_eye))
    return found


def _directions(scene: Scene, wall: np.ndarray) -> np.ndarray | None:
    """Return the walls' normals (W, 3): R_i R n_i = m_w is linear in the entries of R and m.

    None where the second smallest eigenvalue of that is no four times the smallest.
    """
    frames, count = len(wall), int(wall.max()) + 1
    rows = np.zeros((frames, 3, 9 + 3 * count))
    turned = np.einsum("fab,fc->fabc", scene.poses[:, :3, :3], scene.own_normal)
    rows[:, :, :9] = turned.reshape(frames, 3, 9)
    for axis in range(3):
        rows[np.arange(frames), axis, 9 + 3 * wall + axis] = -1
    values, vectors = np.linalg.eigh(np.einsum("fai,faj->ij", rows, rows))
    if values[1] < 4 * max(values[0], TINY):
        return None
    solution = vectors[:, 0] * np.sign(np.linalg.det(vectors[:9, 0].reshape(3, 3)) or 1)
    normal = solution[9:].reshape(count, 3)
    return normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), TINY)


def _with_walls(scene: Scene, found: Alignment, wall: np.ndarray) -> Scene:
    """Return the scene with each wall the plane of least squares through its frames' points."""
    moments = _world_moments(scene, found.hand_eye, found.constant, found.slope)
    weight = 1 / (1 + (found.rms / (3 * max(found.misfit, _LEAST))) ** 2)
    normal, offset = scene.normal.copy(), scene.offset.copy()
    for number in np.unique(wall):
        own = wall == number
        total = np.einsum("f,fab->ab", weight[own], moments[own])
        mean = total[3, :3] / total[3, 3]
        vectors = np.linalg.eigh(total[:3, :3] / total[3, 3] - np.outer(mean, mean))[1]
        direction = vectors[:, 0] * (1.0 if vectors[:, 0] @ scene.normal[own][0] > 0 else -1.0)
        normal[own], offset[own] = direction, -direction @ mean
    return replace(scene, normal=normal, offset=offset)


def _world_moments(scene: Scene, hand_eye: np.ndarray, constant: float, slope: float) -> np.ndarray:
    """Return the mean of (x, 1)(x, 1)^T of each frame's points in the world, shape (F, 4, 4)."""
    corrected = np.zeros((4, 7))
    corrected[:3, :3], corrected[:3, 4:7] = (1 - slope) * np.eye(3), -constant * np.eye(3)
    corrected[3, 3] = 1.0
    form = scene.poses @ hand_eye @ corrected
    return form @ scene.moments @ np.swapaxes(form, 1, 2)
