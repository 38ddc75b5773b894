"""Distances of points to their planes, linear in what a camera's calibration leaves open.

One linear step from the alignment: the hand-eye transform, errors over the distance and the
amplitude, and smooth errors over the image. Whoever looks for something else (another focal length,
a drift of the poses) adds its own columns to these: a function of some lines below.
"""

import math
from collections.abc import Sequence
from copy import copy
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple, Self

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from tofcorr.conditions import CONDITIONS, condition
from tofcorr.estimation.linear import RESOLVED, Curvature
from tofcorr.estimation.robust import without_strays
from tofcorr.geometry.rays import moved_rays, tangents, unambiguous_range
from tofcorr.plausibility.alignment import TINY, Alignment, Scene
from tofcorr.plausibility.finding import MANY_FRAMES, SIGMAS, SPOILS, WORTH_A_WORD

# Knots of the error over the distance. Chosen: over 6 m, three periods of the circular error.
_KNOTS = 8
# Cosine of the angle of incidence from which the distance to the plane is computed. Chosen: 87 deg.
_GRAZING = 0.05
# Waves of the circular error in one unambiguous range: harmonics of four taps (Lange 2000).
_WAVES = np.array([4, 8])


class Estimate(NamedTuple):
    """Least squares estimates of the N unknowns of some columns.

    Attributes:
        value: Shape (N,).
        error: Standard errors, shape (N,). Each frame counts as one observation; infinite where
            there are hardly more frames than determine the unknowns.
        left: What is left of the residuals, shape (F, P), metres.
    """

    value: np.ndarray
    error: np.ndarray
    left: np.ndarray

    @property
    def size(self) -> float:
        """Root of the sum of squares of the values."""
        return float(np.linalg.norm(self.value))

    @property
    def size_error(self) -> float:
        """The same of the standard errors."""
        return float(np.linalg.norm(self.error))


class LinearResiduals:
    """F frames of P pixels, K unknowns.

    Args:
        scene: Poses, planes and pixels, of which those on their frame's own plane are used.
        found: Their alignment, near which the residuals are linear.
        amplitude: Which errors follow, shape (F, P); NaN: unknown; None: that of a matt wall, for
            recordings without. An error by the amplitude changes over a tilted wall as one of focal
            length or distortion does.

    Attributes:
        hand_eye: tool_from_camera of the alignment, shape (4, 4), metres.
        residual: Distance of each point to its plane, shape (F, P), metres.
        columns: Its derivatives by the unknowns, shape (F, P, K).
        rigid: The first of them, by turns and shifts of the hand-eye transform, shape (F, P, 6).
        weight: Of each pixel, shape (F, P), 1 / m^2; zero: not used.
        used: Which pixels are used, shape (F, P), bool.
        cosine: Change of the residual with the distance along the ray, shape (F, P).
        distance: Along the rays to the planes, as the camera should measure it there, shape (F, P),
            metres: what is measured, without its noise; 1 where no pixel is used.
        normal: Of the planes in the camera frame, shape (F, 3).
        world: Where the points should be in the world, shape (F, P, 3), metres.
    """

    def __init__(self, scene: Scene, found: Alignment, amplitude: np.ndarray | None) -> None:
        rays, used = scene.rays, scene.on_plane
        self.scene, self.rays, self.hand_eye = scene, rays, found.hand_eye
        normal_tool, offset_tool = scene.planes_in_tool()
        self.normal = normal_tool @ found.hand_eye[:3, :3]
        offset = normal_tool @ found.hand_eye[:3, 3] + offset_tool
        d = np.where(used, scene.distance, 1.0)
        cosine = self.cosine = np.einsum("fpa,fa->fp", rays, self.normal)
        self.residual = cosine * ((1 - found.slope) * d - found.constant) + offset[:, None]
        # A simulator's frames may fit exactly; no recording tells distances more finely than this.
        typical = np.maximum(found.rms, found.misfit).clip(np.finfo(np.float32).eps)[:, None]
        used = self.used = used & (np.abs(self.residual) < 4 * typical)
        self.weight = np.where(used, 1.0, 0.0) / typical**2
        # Errors are looked for over the distance to the plane, not over the one measured: that has
        # the noise of the residual, which a mixture of columns would explain by what else tells
        # distance. So are places: with that noise, the square of a point's place would follow its
        # residual, and every wall would look bent. A ray along the wall meets it anywhere.
        seen = used & (np.abs(cosine) > _GRAZING)
        noise = self.residual / ((1 - found.slope) * np.where(seen, cosine, 1.0))
        d = self.distance = d - np.where(seen, noise, 0.0)
        points = rays * d[..., None]
        camera = scene.poses @ found.hand_eye
        self.world = np.einsum("fab,fpb->fpa", camera[:, :3, :3], points) + camera[:, None, :3, 3]
        if amplitude is None:
            amplitude = np.where(used, np.abs(cosine) / d**2, np.nan)
        x, y = rays[..., 0] / rays[..., 2], rays[..., 1] / rays[..., 2]
        turned = np.cross(points, self.normal[:, None])
        shifted = np.broadcast_to(normal_tool[:, None], points.shape)
        errors = [*_hats(d, used), x, y, x * x, y * y, x * y, *_brightness(amplitude)]
        along = cosine[..., None] * np.stack(errors, axis=-1)
        self.rigid = np.concatenate([turned, shifted], axis=-1)
        self.columns = np.concatenate([self.rigid, along], axis=-1)

    def frames_for(self, further: int = 0, times: int = 1) -> int:
        """Return how many frames determine the unknowns and further ones, so many times over.

        Each determines three: the offset and two tilts of its plane.
        """
        return math.ceil(times * (self.columns.shape[-1] + further) / 3)

    def with_columns(self, columns: np.ndarray, first: np.ndarray | None = None) -> Self:
        """Return the problem with further unknowns, after all that it has or after `first`."""
        changed = copy(self)
        own = self.columns if first is None else first
        changed.columns = np.concatenate([own, columns], axis=-1)
        return changed

    def image_places(self) -> tuple[Tensor, Tensor]:
        """Return x and y of the rays (x, y, 1), shape (F, P) each."""
        rays = torch.from_numpy(self.rays)
        return rays[..., 0] / rays[..., 2], rays[..., 1] / rays[..., 2]

    def by_moves(self, moves: Sequence[tuple[Tensor, Tensor]], declared: str) -> np.ndarray:
        """Return what each of N moves of the `image_places` does to the residuals, (F, P, N)."""
        rays, distance = torch.from_numpy(self.rays), torch.from_numpy(self.distance)
        normal = torch.from_numpy(self.normal)[:, None].expand(rays.shape)
        moved = [moved_rays(rays, normal, distance, move, declared) for move in moves]
        return torch.stack(moved, dim=-1).numpy()

    def frame_rms(self, left: np.ndarray) -> np.ndarray:
        """Return the root mean square of what is left (F, P) of each frame, shape (F,), metres."""
        count = np.maximum(self.used.sum(1), 1)
        return np.sqrt(np.where(self.used, left**2, 0.0).sum(1) / count)

    @cached_property
    def plane_directions(self) -> np.ndarray:
        """What offset and tilts of a frame's plane do, orthonormal over its pixels, (F, P, 3)."""
        moved = np.where(self.used[..., None], self.rigid, 0.0)
        return np.linalg.svd(moved, full_matrices=False)[0][..., :3]

    def frame_planes_off(self, left: np.ndarray) -> np.ndarray:
        """Return how far the planes of what is left (F, P) are from flat and zero, (F,), metres.

        Root mean square over a frame's pixels: what a wrong pose or plane does, and no error of
        single pixels.
        """
        count = np.maximum(self.used.sum(1), 1)
        planes = np.einsum("fpa,fp->fa", self.plane_directions, left)
        return np.linalg.norm(planes, axis=1) / np.sqrt(count)

    def added(self, *blocks: np.ndarray) -> list[Estimate]:
        """Estimate the unknowns of blocks of columns (F, P, N) beside those of the problem.

        Returns:
            An estimate for each block; all have the same residuals left.
        """
        columns = np.concatenate([self.columns, *blocks], axis=-1)
        weighted = columns * self.weight[..., None]
        matrix = np.einsum("fpa,fpb->ab", weighted, columns, optimize=True)
        inverse = Curvature(torch.from_numpy(matrix)).inverse.numpy()
        unknowns = -inverse @ np.einsum("fpa,fp->a", weighted, self.residual)
        left = self.residual + columns @ unknowns
        scores = np.einsum("fpa,fp->fa", weighted, left) @ inverse
        # The residuals are smaller than the errors, by the unknowns that were fitted to them.
        count, error = len(self.residual), np.full(len(inverse), np.inf)
        freedom = count - len(unknowns) / 3
        if freedom > 0:
            error = np.sqrt(count / freedom * np.square(scores).sum(axis=0))
        ends = np.cumsum([self.columns.shape[-1], *(block.shape[-1] for block in blocks)])
        return [Estimate(unknowns[a:b], error[a:b], left) for a, b in pairwise(ends)]


def _hats(d: np.ndarray, used: np.ndarray) -> np.ndarray:
    """Return hat functions over the distance, which sum to one, shape (8, ...).

    Few pixels of a steep wall are several times as far as all others, and would take most of the
    knots: the knots end where stray pixels may begin.
    """
    low, high = without_strays(d[used]) if used.any() else (0.0, 1.0)
    place = ((d - low) / max(high - low, TINY)).clip(0, 1) * (_KNOTS - 1)
    return np.maximum(1 - np.abs(place - np.arange(_KNOTS)[:, None, None]), 0.0)


def _brightness(amplitude: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the logarithm of the amplitude and its square, standardised, shape (F, P) each.

    Amplitudes are cut below at a thousandth of the typical one: the logarithm of none is infinite.
    """
    known = amplitude[np.isfinite(amplitude)]
    typical = float(np.median(known)) if len(known) else 1.0
    filled = np.nan_to_num(amplitude, nan=typical)
    bright = _standardised(np.log(np.maximum(filled, max(typical, TINY) / 1000)))
    return bright, bright**2


def by_conditions(conditions: np.ndarray) -> np.ndarray:
    """Return the conditions that were recorded of all frames and differ, standardised, (F, K).

    K is 0 where there are few frames.

    Args:
        conditions: In the order of `CONDITIONS`, shape (F, C); NaN: unknown.
    """
    few, found = len(conditions) < MANY_FRAMES, []
    for name, values in zip(CONDITIONS, conditions.T, strict=True):
        kind = condition(name)
        if not few and not kind.required and np.isfinite(values).all() and np.ptp(values) > 0:
            found.append(_standardised(np.log(values) if kind.positive else values))
    return np.stack(found, axis=-1) if found else np.zeros((len(conditions), 0))


def by_phase(problem: LinearResiduals, frequency: float | None) -> np.ndarray:
    """Return sine and cosine of the waves of the circular error at the distances, (F, P, 4).

    The last axis has length 0 where the modulation frequency (Hz) is unknown, or where the
    distances used span less than one wave: straight pieces over the distance follow that much.
    """
    distance, used = problem.distance, problem.used
    longest = unambiguous_range(frequency) / _WAVES[0] if frequency else np.inf
    span = np.ptp(distance[used]) if used.any() else 0.0
    if len(distance) < MANY_FRAMES or span < longest:
        return np.zeros((*distance.shape, 0))
    phase = 2 * np.pi / longest * distance[..., None] * (_WAVES / _WAVES[0])
    return np.concatenate([np.sin(phase), np.cos(phase)], axis=-1)


def _standardised(values: np.ndarray) -> np.ndarray:
    return (values - values.mean()) / max(float(values.std()), TINY)


def image_shape(problem: LinearResiduals, declared: str) -> dict[str, Estimate] | None:
    """Estimate errors of the header, and bends of the target.

    A wrong camera or kind bends a wall in proportion to its distance, and by its tilt; errors of
    distances do neither. Each error of K and distortion is estimated as if it were the only one:
    seldom are there two.

    Args:
        problem: The residuals.
        declared: `radial` or `z`.

    Returns:
        None where there are too few frames, or the hand-eye transform is fixed. Else

        - `focal`: relative error of the focal length: 0.1 if it should be 10 % longer;
        - `aspect`: that of the horizontal focal length minus that of the vertical one;
        - `centre`: how far the principal point should move to the right and down, relative to the
          focal length;
        - `corner`: how far the distortion should move the corner of the image outward, relative to
          the focal length;
        - `bend`: how far the corner should move to the right and down where the image's axes are
          bent, as by a wedge of glass or a tilted lens (thin prism distortion);
        - `kind`: 0: the depth is of the kind declared; 1: it is of the other one;
        - `curvature`: of the target along two directions on it, and mixed, 1/m: its points lie that
          many metres off its plane at a metre from its middle. With it, all of the above but `bend`
          are estimated together: `left` of `kind` is what no error of a camera explains;
        - `room`: how far a target 1 m off and seen head on reads too near, metres, by light of one
          brightness everywhere on it; too far is negative;
        - `rim`: how far the four ends of what is seen of the target, along these directions, read
          too near, metres; it falls to a third within a tenth of the width.
    """
    scene = problem.scene
    # The errors estimated together are nine.
    if not scene.moves or len(scene.poses) <= problem.frames_for(9):
        return None
    x, y = problem.image_places()
    # In units of the corner's.
    square = (x * x + y * y) / (x * x + y * y).max().clamp(min=TINY)
    outward = square / (x * x + y * y).max().clamp(min=TINY).sqrt()
    one, zero = torch.ones_like(x), torch.zeros_like(x)
    # A focal length longer by a share s makes (x, y) shorter by it; the depth stays as it was.
    moves = {
        "focal": [(-x, -y)],
        "aspect": [(-x / 2, y / 2)],
        "centre": [(-one, zero), (zero, -one)],
        "corner": [(-x * outward, -y * outward)],
        "bend": [(-square, zero), (zero, -square)],
    }
    blocks = {name: problem.by_moves(own, declared) for name, own in moves.items()}
    # Light by way of a room, of one brightness everywhere on the target: relative to the direct
    # light it grows with the square of the distance over the cosine of incidence, so that points
    # miss their plane with the former alone. It bends walls as a focal length does.
    room = (np.sign(problem.cosine) * problem.distance**2)[..., None]
    with_room = problem.with_columns(room)
    found = {name: with_room.added(block)[0] for name, block in blocks.items()}
    found["room"] = problem.added(room)[0]
    other = np.log(problem.rays[..., 2]) * (-1 if declared == "radial" else 1)
    kind = (problem.cosine * problem.distance * other)[..., None]
    s, t = places_on_wall(problem)
    bent = np.stack([s * s, t * t, s * t], axis=-1)
    del blocks["bend"]
    rim = [_from_end(sign * place, problem.used) for place in (s, t) for sign in (1, -1)]
    found["rim"] = problem.added(problem.cosine[..., None] * np.stack(rim, axis=-1))[0]
    found["curvature"], *_, found["kind"] = problem.added(bent, *blocks.values(), kind)
    return found


def _from_end(place: np.ndarray, used: np.ndarray) -> np.ndarray:
    """Return what falls from 1 at the largest of the places that are used, (F, P)."""
    low, high = np.quantile(place[used], [0.01, 0.99])
    return np.exp(10 * (place.clip(low, high) - high) / max(high - low, TINY))


def exact_camera(problem: LinearResiduals, declared: str) -> tuple[Estimate, np.ndarray]:
    """Estimate how K should change where the hand-eye transform is exact, as a simulator's.

    A shift of the principal point then shows beside all errors of distances: with a hand-eye
    transform to be found, a turn of the camera looks much like it.

    Args:
        problem: The residuals near the exact transform; its turns and shifts are left out.
        declared: `radial` or `z`.

    Returns:
        - principal point to the right and down in focal lengths, and the horizontal and the
          vertical focal length as shares of themselves;
        - what each of them does to the M residuals that are used, shape (M, 4), metres.
    """
    x, y = problem.image_places()
    one, zero = torch.ones_like(x), torch.zeros_like(x)
    block = problem.by_moves([(-one, zero), (zero, -one), (-x, zero), (zero, -y)], declared)
    of_camera = problem.columns[..., problem.rigid.shape[-1] :]
    (found,) = problem.with_columns(of_camera, first=block[..., :0]).added(block)
    return found, block[problem.used] * found.value


def places_on_wall(problem: LinearResiduals) -> tuple[np.ndarray, np.ndarray]:
    """Return the points' places on the target along two directions, from its middle, metres."""
    across = tangents(torch.from_numpy(problem.scene.normal)).numpy()
    s, t = np.einsum("fpa,fka->kfp", problem.world, across)
    return s - np.median(s[problem.used]), t - np.median(t[problem.used])


def pose_drift(problem: LinearResiduals, *, warming: bool = False) -> Estimate | None:
    """Estimate by how much the robot's poses, the camera, or the wall, move steadily away.

    The world shifts and turns in proportion to the frame's number. The size of the estimate is the
    root mean square of how far points move off their planes from the first frame to the last.

    Args:
        problem: The residuals, in the order in which the frames were recorded.
        warming: Whether all distances may change steadily too, as those of a warming camera.

    Returns:
        None where there is none, or there are too few frames.
    """
    scene, used = problem.scene, problem.used
    if len(scene.poses) < problem.frames_for(4, times=2):
        return None
    shifted = np.broadcast_to(scene.normal[:, None], problem.world.shape)
    turned = np.cross(problem.world - problem.world[used].mean(0), scene.normal[:, None])
    drift = np.concatenate([shifted, turned], axis=-1)
    # Unknowns of which each moves the points by as much, and independently.
    _, extent, directions = np.linalg.svd(drift[used], full_matrices=False)
    resolved = extent > RESOLVED * extent[0]
    drift = drift @ (directions[resolved].T * np.sqrt(used.sum()) / extent[resolved])
    when = np.linspace(-0.5, 0.5, len(scene.poses))[:, None, None]
    found = problem.added(*[when * drift, when * problem.cosine[..., None]][: 1 + warming])[0]
    # 80 clean recordings had 2 mm.
    return found if found.size > max(SPOILS, 6 * found.size_error) else None


Late = tuple[tuple[str, str], float, Estimate]
"""What holds a share of what; the share, without unit; and the root mean square of how far that
moves points off their planes, metres."""


def lateness(
    problem: LinearResiduals, before: np.ndarray, after: np.ndarray, planes: np.ndarray
) -> Late | None:
    """Estimate whether poses and images are of different moments, by a share of each move.

    A pose may hold a share of the move from the frame before, or to the next. A camera that filters
    over time shows a share of what it saw before.

    Args:
        problem: The residuals.
        before: world_from_tool of the frame recorded before each, shape (F, 4, 4), metres.
        after: The same of the frame after it.
        planes: Normal and offset of the plane of the frame before, in the world, (F, 4), metres.

    Returns:
        What explains most; None where nothing surely is late. Without a robot no pose is.
    """
    scene, place = problem.scene, problem.scene.poses[:, None, :3, 3]
    if len(scene.poses) < problem.frames_for(1, times=2):
        return None
    columns: dict[tuple[str, str], np.ndarray] = {}
    for move, other in (("before", before), ("after", after)) if scene.moves else ():
        turn = Rotation.from_matrix(other[:, :3, :3] @ scene.poses[:, :3, :3].mT).as_rotvec()
        step = other[:, None, :3, 3] - place + np.cross(turn[:, None], problem.world - place)
        columns["pose", f"the move {move} it"] = np.einsum("fpa,fa->fp", step, scene.normal)
    camera, seen = before @ problem.hand_eye, problem.distance[problem.used]
    normal, offset = planes[:, :3], planes[:, 3]
    height = (camera[:, :3, 3] * normal).sum(-1) + offset
    cosine = np.einsum("fpa,fba,fb->fp", problem.rays, camera[:, :3, :3].mT, normal)
    # Where no wall was seen, something as far as the walls are is in the image.
    held = (-height[:, None] / np.minimum(cosine, -_GRAZING)).clip(seen.min(), seen.max())
    columns["image", "the one before it"] = problem.cosine * (held - problem.distance)
    late: list[Late] = []
    for what, column in columns.items():
        size = max(float(np.sqrt(np.mean(column[problem.used] ** 2))), TINY)
        (found,) = problem.added(column[..., None] / -size)  # An estimate takes it off.
        if found.value[0] > max(WORTH_A_WORD, SIGMAS * found.size_error):
            late.append((what, float(found.value[0]) / size, found))
    return min(late, key=lambda one: problem.frame_rms(one[2].left).sum(), default=None)


def length_scale(given: Alignment, problem: LinearResiduals) -> tuple[float, float]:
    """Return by how much longer distances are than the poses say, as a share, and its error.

    Poses, planes through the origin and hand-eye, all longer by a share, look exactly like
    distances shorter by it: a recording cannot tell whether the robot or the camera is wrong. It is
    estimated beside errors of amplitude and place, with no other error over the distance.
    """
    longer = np.stack([problem.cosine, problem.cosine * problem.distance], axis=-1)
    others = problem.with_columns(problem.columns[..., 6 + _KNOTS :], first=problem.rigid)
    (found,) = others.added(longer)
    # On a white wall the amplitude follows the distance, and the frames decide.
    few = len(problem.scene.poses) < others.frames_for(2, times=2)
    return given.slope - float(found.value[-1]), np.inf if few else float(found.error[-1])
