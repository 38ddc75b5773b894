"""What a recording claims, reduced to moments: poses, planes, and the points that were measured."""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np


@dataclass(frozen=True, eq=False)
class Scene:
    """Poses, planes and points of F frames.

    Attributes:
        poses: world_from_tool, shape (F, 4, 4), metres.
        normal: Of the planes in the world, shape (F, 3).
        offset: Of the planes, shape (F,), metres.
        moments: Mean of q q^T over a frame's pixels with q = (point, 1, ray) in the camera frame,
            shape (F, 7, 7).
        own_normal: Of the plane through the frame's own points, camera frame, shape (F, 3).
        known: Whether that plane is determined, shape (F,), bool.
        moves: Whether a robot moves the camera; without one the hand-eye is the identity.
        guess: The recorded tool_from_camera, shape (4, 4).
    """

    poses: np.ndarray
    normal: np.ndarray
    offset: np.ndarray
    moments: np.ndarray
    own_normal: np.ndarray
    known: np.ndarray
    moves: bool
    guess: np.ndarray

    def planes_in_tool(self) -> tuple[np.ndarray, np.ndarray]:
        """Return normals (F, 3) and offsets (F,) of the planes in the tool frame."""
        rotation, place = self.poses[:, :3, :3], self.poses[:, :3, 3]
        normal = np.einsum("fba,fb->fa", rotation, self.normal)
        return normal, (self.normal * place).sum(1) + self.offset

    def some(self, chosen: np.ndarray) -> Self:
        """Return the scene of some frames, by index or by mask."""
        per_frame = ("poses", "normal", "offset", "moments", "own_normal", "known")
        return replace(self, **{name: getattr(self, name)[chosen] for name in per_frame})


def moments_of(rays: np.ndarray, distance: np.ndarray, used: np.ndarray) -> np.ndarray:
    """Return the moments of `Scene` from rays (F, P, 3), distances and pixels used (F, P)."""
    one = used[..., None].astype(np.float64)
    points = rays * np.where(used, distance, 0.0)[..., None]
    joined = np.concatenate([points, one, rays * one], axis=-1)
    total = np.einsum("fpa,fpb->fab", joined, joined, optimize=True)
    return total / np.maximum(used.sum(1), 1)[:, None, None]
