"""The alignment without trust in the recorded planes: every wall is estimated with the hand-eye."""

from dataclasses import replace

import numpy as np

from tofcorr.plausibility.alignment import Alignment, align
from tofcorr.plausibility.scene import Scene

# Recorded planes are one wall if normal and offset agree to so many decimals; as in fit.
_DECIMALS = 4
# Rounds of walls from the alignment and alignment from the walls. Chosen: beyond, the misfit of
# walls 40 degrees off falls by less than a tenth.
_ROUNDS = 8
# Ratio of the second smallest to the smallest eigenvalue below which the directions of walls and
# hand-eye are not determined. Chosen.
_DETERMINED = 4.0
# Fewest frames of a wall: three unknowns each.
_FEWEST_IMAGES = 4


def walls_of(scene: Scene) -> np.ndarray:
    """Return a number for each frame's wall, shape (F,): frames of one recorded plane share it."""
    planes = np.round(np.column_stack([scene.normal, scene.offset]), _DECIMALS)
    return np.unique(planes, axis=0, return_inverse=True)[1].reshape(-1)


def align_with_free_walls(scene: Scene) -> Alignment | None:
    """Return the alignment on walls estimated with it; None where the frames do not allow it."""
    wall = walls_of(scene)
    counts = np.bincount(wall)
    if not scene.moves or counts.min() < _FEWEST_IMAGES or not scene.known.all():
        return None
    starts = [scene]
    normal = _directions(scene, wall)
    if normal is not None:
        starts.append(_with_offsets(replace(scene, normal=normal[wall]), wall))
    return min((_alternated(start, wall) for start in starts), key=lambda one: one.misfit)


def _alternated(scene: Scene, wall: np.ndarray) -> Alignment:
    found = align(scene)
    for _ in range(_ROUNDS):
        scene = _with_walls(scene, found, wall)
        found = align(replace(scene, guess=found.hand_eye))
    return found


def _directions(scene: Scene, wall: np.ndarray) -> np.ndarray | None:
    """Return the walls' normals (W, 3): R_i R n_i = m_w is linear in the entries of R and m."""
    count = int(wall.max()) + 1
    size = 9 + 3 * count
    matrix = np.zeros((size, size))
    for pose, own, number in zip(scene.poses[:, :3, :3], scene.own_normal, wall, strict=True):
        rows = np.zeros((3, size))
        rows[:, :9] = np.einsum("ab,c->abc", pose, own).reshape(3, 9)
        rows[:, 9 + 3 * number : 12 + 3 * number] = -np.eye(3)
        matrix += rows.T @ rows
    values, vectors = np.linalg.eigh(matrix)
    if values[1] < _DETERMINED * max(values[0], 1e-12):
        return None
    solution = vectors[:, 0]
    if np.linalg.det(solution[:9].reshape(3, 3)) < 0:
        solution = -solution
    normal = solution[9:].reshape(count, 3)
    return normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)


def _with_offsets(scene: Scene, wall: np.ndarray) -> Scene:
    """Return the scene with each wall at the middle of its frames' points, the hand-eye guessed."""
    points = _world_moments(scene, np.eye(4), 0.0, 0.0)
    offset = np.array(
        [-(points[wall == w, 3, :3].mean(0) @ scene.normal[wall == w][0]) for w in np.unique(wall)]
    )
    return replace(scene, offset=offset[wall])


def _with_walls(scene: Scene, found: Alignment, wall: np.ndarray) -> Scene:
    """Return the scene with each wall the plane of least squares through its frames' points."""
    moments = _world_moments(scene, found.hand_eye, found.constant, found.slope)
    weight = 1 / (1 + (found.rms / (3 * max(found.misfit, 1e-4))) ** 2)
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
    corrected[:3, :3] = (1 - slope) * np.eye(3)
    corrected[:3, 4:7] = -constant * np.eye(3)
    corrected[3, 3] = 1.0
    form = scene.poses @ hand_eye @ corrected
    return form @ scene.moments @ np.swapaxes(form, 1, 2)
