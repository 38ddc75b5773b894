"""The hand-eye transform under which measured points lie best on the recorded planes.

The steps are those of a fit (`estimation`), on a few pixels of each frame and robust over frames: a
few wrong poses do not move it. A constant error of the distance and one in proportion to it are
estimated as well, since every camera has them. Where nobody measured the planes, every wall is
estimated with the hand-eye.
"""

from copy import copy
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor

from tofcorr.estimation.linear import NormalEquations, solved
from tofcorr.estimation.moments import LEAST_RESIDUAL, ImageMoments, MomentObjective, Parameters
from tofcorr.estimation.planes import Walls, joint_image_equations
from tofcorr.estimation.robust import (
    deviation,
    largest_plane,
    robust_weights,
    sigma_from_mad,
)
from tofcorr.estimation.solvers import rotation_from_normals
from tofcorr.geometry import se3
from tofcorr.geometry.rays import plane_in_frame, planes_through
from tofcorr.pixels.dataset import Dataset
from tofcorr.plausibility.finding import CAMERA, FAR_OFF, LARGE_CONSTANT

TINY = float(np.finfo(np.float64).tiny)
"""What a divisor is at the least."""
# Prior standard deviations of the constant error, metres (large), and of the error in proportion to
# the distance (clocks are right to a percent, and no unit may hide in it). Chosen; against a misfit
# of one frame of 10 mm. The hand-eye has one of a metre and a radian, wide enough for any.
_PRIOR = torch.tensor([1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 0.05, 0.01], dtype=torch.float64) / 0.01


class Scene:
    """What a recording claims: poses, planes and the P points of each of F frames.

    The plane of a frame's own points is the largest one, fitted to the pixels near it.

    Args:
        data: The recordings.
        frames: Global numbers of the frames, shape (F,).
        rays: Unit rays, shape (F, P, 3).
        stored: Depths as stored, shape (F, P), metres; NaN: not usable.

    Attributes:
        poses: world_from_tool, shape (F, 4, 4), metres.
        normal: Of the planes in the world, shape (F, 3).
        offset: Of the planes, shape (F,), metres.
        rays: Unit rays, shape (F, P, 3).
        distance: Along the rays, shape (F, P), metres; NaN: not usable.
        own_normal: Of the plane through the frame's own points, on the camera's side, in the camera
            frame, shape (F, 3).
        cosine: Between rays and that normal, shape (F, P).
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

    def __init__(
        self, data: Dataset, frames: np.ndarray, rays: np.ndarray, stored: np.ndarray
    ) -> None:
        own = (one.numpy() for one in data.planes_and_poses(frames))
        self.normal, self.offset, self.poses = own
        self.moves, self.rays = data.moves, rays
        self.guess = np.asarray(data.first.tool_from_camera, dtype=np.float64)
        self.distance = stored / rays[..., 2] if data.first.depth_kind == "z" else stored
        valid = np.isfinite(self.distance)
        # On a base as short, as seen from 1 m, errors of the camera turn the plane anywhere. And
        # three pixels determine a plane, six can judge it.
        of_rays = _moments(rays, self.distance, valid)[:, 3:, 3:]
        spread = of_rays[:, 1:, 1:] - of_rays[:, 1:, :1] * of_rays[:, :1, 1:]
        self.known = np.linalg.eigvalsh(spread)[:, 1] > CAMERA**2
        self.known &= valid.sum(1) >= 6
        self.on_plane = valid.copy()
        for k in np.flatnonzero(self.known):
            own = _tensors(rays[k, valid[k]], self.distance[k, valid[k]])
            plane = largest_plane(own[0], own[1], FAR_OFF, torch.Generator().manual_seed(0))
            if plane is not None:
                off = deviation(own[0], own[1], plane).abs()
                near = max(4 * sigma_from_mad(float(off.median())), CAMERA)
                self.on_plane[k, valid[k]] = (off <= near).numpy()
        self.moments = _moments(rays, self.distance, self.on_plane)
        points = torch.from_numpy(self.moments[:, :4, :4])
        # The camera is the origin; the normal points to its side.
        normal, offset = planes_through(points, torch.zeros(3).double())
        plane = torch.cat([normal, offset[:, None]], dim=1)
        squares = torch.einsum("fa,fab,fb->f", plane, points, plane)
        self.own_normal, self.flatness = normal.numpy(), squares.clamp(min=0).sqrt().numpy()
        self.cosine = np.einsum("fpa,fa->fp", rays, self.own_normal)
        with np.errstate(divide="ignore", invalid="ignore"):  # Of frames without a plane.
            self.off_by = self.distance + offset[:, None].numpy() / self.cosine

    def changed(self, **parts: Any) -> Self:  # noqa: ANN401 - attributes
        """Return the scene with other attributes."""
        other = copy(self)
        vars(other).update(parts)
        return other

    def planes_in_tool(self) -> tuple[np.ndarray, np.ndarray]:
        """Return normals (F, 3) and offsets (F,) of the planes in the tool frame."""
        normal, offset = plane_in_frame(*_tensors(self.normal, self.offset, self.poses))
        return normal.numpy(), offset.numpy()

    def image_moments(self) -> ImageMoments:
        """Return the moments that a fit of a constant and a slope of the distance needs."""
        # Columns of a point, its ray (the constant), the point again (the slope), and 1.
        order = [0, 1, 2, 4, 5, 6, 0, 1, 2, 3]
        parts = self.moments[:, order][:, :, order], *self.planes_in_tool()
        gram, normal, offset = _tensors(*parts)
        return ImageMoments(gram, normal, offset, gram[:, -1, -1], ["c0", "slope"])

    def some(self, chosen: np.ndarray) -> Self:
        """Return the scene of some frames, by index or by mask."""
        whole = ("moves", "guess")
        parts = {name: all_[chosen] for name, all_ in vars(self).items() if name not in whole}
        return self.changed(**parts)


def _moments(rays: np.ndarray, distance: np.ndarray, used: np.ndarray) -> np.ndarray:
    one = used[..., None].astype(np.float64)
    points = rays * np.where(used, distance, 0.0)[..., None]
    joined = np.concatenate([points, one, rays * one], axis=-1)
    total = np.einsum("fpa,fpb->fab", joined, joined, optimize=True)
    return total / np.maximum(used.sum(1), 1)[:, None, None]


def _tensors(*arrays: np.ndarray) -> list[Tensor]:
    # Poses may be mirrored views, which torch does not take.
    return [torch.from_numpy(np.ascontiguousarray(one)) for one in arrays]


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
        distance: The median one of the points, metres.
    """

    hand_eye: np.ndarray
    constant: float
    slope: float
    rms: np.ndarray
    angle: np.ndarray
    distance: float

    @property
    def misfit(self) -> float:
        """Median over the frames of their distance to their planes, metres."""
        return float(np.median(self.rms)) if len(self.rms) else 0.0

    @property
    def badness(self) -> float:
        """Misfit, and a tenth of what the constant error exceeds a large one by, metres.

        Points of another surface may lie parallel to the target: then only the constant shows it.
        """
        return self.misfit + max(abs(self.constant) - LARGE_CONSTANT, 0.0) / 10

    @property
    def relative(self) -> float:
        """Misfit, and a tenth of constant and slope, as shares of the distance: in any unit."""
        off = self.misfit + abs(self.constant) / 10
        return max(off, LEAST_RESIDUAL) / self.distance + abs(self.slope) / 10

    @property
    def typical_angle(self) -> float:
        """Median over the frames of the angle between the two planes, radians; NaN: unknown."""
        known = self.angle[~np.isnan(self.angle)]
        return float(np.median(known)) if len(known) else np.nan


def judged(scene: Scene, hand_eye: np.ndarray, constant: float, slope: float) -> Alignment:
    """Return how far frames are from their planes under a given hand-eye transform."""
    errors = torch.tensor([constant, slope], dtype=torch.float64)
    return _judged(scene, scene.image_moments(), Parameters(torch.from_numpy(hand_eye), errors))


def _judged(scene: Scene, moments: ImageMoments, at: Parameters) -> Alignment:
    rms = MomentObjective(moments).image_losses(at).clamp(min=0).sqrt().numpy()
    normal = (moments.normal_tool @ at.tool_from_camera[:3, :3]).numpy()
    cosine = (scene.own_normal * normal).sum(1).clip(-1, 1)
    angle = np.where(scene.known, np.arccos(cosine), np.nan)
    constant, slope = at.coefficients.tolist()
    distance = float(np.nanmedian(scene.distance))
    return Alignment(at.tool_from_camera.numpy(), constant, slope, rms, angle, distance)


def align(scene: Scene, walls: Walls | None = None) -> Alignment:
    """Return the best hand-eye transform; without a robot it is the identity.

    Args:
        scene: Poses, planes and points.
        walls: Where estimated walls start; None: the planes of the scene are right.
    """
    found = (_refined(scene, start, walls) for start in _starts(scene))
    return min(found, key=lambda one: one.misfit)


def walls_of(scene: Scene) -> np.ndarray:
    """Return a number for each frame's wall, shape (F,): frames of one recorded plane share it.

    Planes are one wall if normal and offset agree to four decimals; as in fit.
    """
    planes = np.round(np.column_stack([scene.normal, scene.offset]), 4)
    return np.unique(planes, axis=0, return_inverse=True)[1].reshape(-1)


def align_with_free_walls(scene: Scene) -> Alignment | None:
    """Return the alignment on walls estimated with it; None where the frames do not allow it.

    A wall needs four frames: it has three unknowns.
    """
    wall = walls_of(scene)
    if not scene.moves or np.bincount(wall).min() < 4 or not scene.known.all():
        return None
    first = np.unique(wall, return_index=True)[1]
    parts = scene.normal[first], scene.offset[first], wall, scene.poses
    return align(scene, Walls(*_tensors(*parts)))


def _refined(scene: Scene, start: Tensor, walls: Walls | None) -> Alignment:
    """Take Gauss-Newton steps with the frames weighted by their misfit."""
    recorded = moments = scene.image_moments()
    at = Parameters(start, torch.zeros(2, dtype=torch.float64), scene.moves)
    unknowns = at.size + (0 if walls is None else walls.size)
    # On the walls lies the hand-eye's prior of a metre and a radian.
    scale = torch.cat([_PRIOR[-at.size :], _PRIOR[:1].expand(unknowns - at.size)]) ** -2
    # Quadratic convergence from the closed form takes five, the weights a few more.
    for _ in range(12):
        rms = MomentObjective(moments).image_losses(at).clamp(min=0).sqrt()
        weight = robust_weights(rms / rms.quantile(0.5).clamp(min=LEAST_RESIDUAL), "cauchy")
        images = joint_image_equations(moments.weighted(weight), at, walls).total()
        pull = torch.nn.functional.pad(at.coefficients, (at.twist_size, unknowns - at.size))
        equations = images.plus(NormalEquations(images.loss, scale * pull, scale.diag()))
        step = -solved(equations.hessian, equations.gradient)
        at = at.moved(step[: at.size])
        if walls is not None:
            walls = walls.moved(step[at.size :])
            moments = walls.seen_by(recorded)
    return _judged(scene, moments, at)


def _starts(scene: Scene) -> list[Tensor]:
    """Return the recorded guess, and closed forms from all frames and from the best of some.

    With a third of the poses wrong, one of 12 subsets of 4 is right with a probability of 0.93.
    """
    if not scene.moves:
        return [torch.eye(4, dtype=torch.float64)]
    guess, known = torch.from_numpy(scene.guess), np.flatnonzero(scene.known)
    in_tool, own = _tensors(scene.planes_in_tool()[0][known], scene.own_normal[known])
    rotations = [rotation_from_normals(in_tool, own, guess[:3, :3])]
    if len(known) > 4:
        generator = np.random.default_rng(0)
        drawn = [generator.choice(len(known), 4, replace=False) for _ in range(12)]
        tried = [rotation_from_normals(in_tool[some], own[some], guess[:3, :3]) for some in drawn]
        rotations.append(min(tried, key=lambda one: (in_tool @ one - own).abs().sum(1).median()))
    return [guess, *(se3.assemble(one, torch.zeros(3).to(one)) for one in rotations)]
