"""Scenes that are drawn for a camera, and what the removal of second bounces leaves in them.

A scene is a box with some of its faces, the room about the camera, and smaller boxes of the same
kind: whole ones, and open ones, whose faces are panels, shelves and corners. The light is followed
among all that a wider view sees, out to where the light reaches; the camera sees its part of it.
"""

import math
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from tofcorr.geometry.camera import CameraIntrinsics
from tofcorr.geometry.se3 import exp
from tofcorr.scene_light.bounces import SecondBounces, SecondBouncesState
from tofcorr.scene_light.remainder import Remainder, RemainderOptions

Draw = np.random.Generator
Noise = tuple[float, float, float]

_SCENES: dict[str, Any] = {
    # Walls to the left and right, ceiling, floor, nothing at the camera, and the wall ahead: how
    # often there is one, and from where to where, metres. One that is missing is far away.
    "walls": ((0.35, 0.35, 0.2, 0.65, 0, 0.9), (0.5, 0.5, 0.5, 0.4, 0, 1), (3, 3, 2.5, 1.5, 0, 3)),
    "no_room": 0.4,  # Share of scenes without any wall.
    "ends": (-0.8, 1),  # Where side walls and floor end before the camera, of the way to the wall.
    "view": (0.3, 0.4, 0.2),  # By which the camera is turned, standard deviations, radians.
    "boxes": 1.5,  # Mean number.
    "half": (0.08, 0.6),  # Half sides of a box, metres.
    "stands": 0.7,  # How often it stands on the floor.
    "across": (0.9, 0.5, 1.0),  # How far it is beside the middle, above it, and before the wall.
    "tilted": 0.2,  # How often it is tilted.
    "open": (1.0, 0.6),  # Of its faces are there, each by half of the boxes.
    "grey": (0.3, 0.9),  # Reflectivities.
    "nearest": 0.3,  # Metres to what is seen.
    "filled": 0.1,  # Share of the image at least.
}
"""What is drawn. Chosen: rooms and things as robots meet them."""
_TRAINING = 40, 8, 3e-3
"""Rounds over all scenes, frames of a step, and its largest rate. Set on drawn scenes held out."""


class Faces(NamedTuple):
    """Parallelograms in the camera's axes: corners (K, 3), sides (K, 3, 2), reflectivities (K,)."""

    corner: Tensor
    sides: Tensor
    grey: Tensor

    def met(self, rays: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return g of 1 / r = g . ray (3, N), NaN without a face, and number and grey (N,)."""
        normal = torch.linalg.cross(self.sides[..., 0], self.sides[..., 1])
        planes = normal / (normal * self.corner).sum(1, keepdim=True)
        near = planes @ rays
        shares = torch.linalg.pinv(self.sides) @ (rays / near[:, None] - self.corner[..., None])
        hit = (near > 0) & (shares > 0).all(1) & (shares < 1).all(1)
        nearest, face = torch.where(hit, near, 0.0).max(0)
        return torch.where(nearest > 0, planes[face].T, math.nan), face, self.grey[face]


def _box(draw: Draw, low: Tensor, high: Tensor, turn: Tensor, kept: np.ndarray) -> Faces:
    """Return the kept ones of the faces of a box: left, right, top, bottom, front and back."""
    size, axes = torch.diag(high - low), [[1, 2], [0, 2], [0, 1]]
    corner = torch.stack([low + k * size[axis] for axis in range(3) for k in (0, 1)]) @ turn.T
    sides = turn @ torch.stack([size[:, axes[axis]] for axis in range(3) for _ in range(2)])
    grey = torch.tensor(draw.uniform(*_SCENES["grey"], size=6))
    return Faces(corner[kept], sides[kept], grey[kept])


def _turn(angles: np.ndarray) -> Tensor:
    """Return the rotation (3, 3) of a rotation vector."""
    return exp(torch.tensor([0.0, 0.0, 0.0, *angles], dtype=torch.float64))[:3, :3]


def drawn(draw: Draw) -> Faces:
    """Draw a scene."""
    often, least, most = (np.array(each) for each in _SCENES["walls"])
    kept = draw.random(6) < often * (draw.random() > _SCENES["no_room"])
    reach = np.where(kept | (often == often.max()), draw.uniform(least, most), 8)
    reach[4] = draw.uniform(*_SCENES["ends"]) * reach[5]
    view = _turn(draw.normal(0, _SCENES["view"]))
    made = [_box(draw, torch.tensor(-reach[::2]), torch.tensor(reach[1::2]), view, kept)]
    for _ in range(draw.poisson(_SCENES["boxes"]) + (not kept.any())):
        half, tilts = draw.uniform(*_SCENES["half"], size=3), draw.random() < _SCENES["tilted"]
        middle = np.array(_SCENES["across"]) * draw.uniform([-1, -1, 0], 1)
        middle[2] = reach[5] - middle[2]
        if draw.random() < _SCENES["stands"]:
            middle[1] = min(reach[3], most[3]) - half[1]
        turn = view @ _turn(draw.normal(size=3) * [tilts, 1, tilts])
        kept = draw.random(6) < draw.choice(_SCENES["open"])
        box = _box(draw, -torch.tensor(half), torch.tensor(half), turn, kept)
        made.append(box._replace(corner=box.corner + view @ torch.tensor(middle)))
    return Faces(*map(torch.cat, zip(*made, strict=True)))


class Drawn(NamedTuple):
    """A frame of a scene, on the cells of a camera.

    Attributes:
        read: What the network reads (11, R, C).
        left: What the removal of second bounces leaves in the distances (N,), metres.
        distance: True, metres (N,).
        face: Number of the surface (N,).
    """

    read: Tensor
    left: Tensor
    distance: Tensor
    face: Tensor


class Drawing:
    """Frames of drawn scenes.

    Args:
        camera: The intrinsics.
        state: Frequencies, gain, patches and light.
        noise: a, b, c of the variance a + b / A + c / A^2 of a pixel's distance at amplitude A.
        width: Features of the network.
    """

    def __init__(
        self, camera: CameraIntrinsics, state: SecondBouncesState, noise: Noise, width: int
    ) -> None:
        self.own, self.noise = SecondBounces(camera, state), noise
        self.size = self.own.rows, self.own.columns
        self.network = Remainder(self.own.rows, width)
        half, own = state.light_half_angle_deg, float(self.own.rays[2].min())
        self.cosine = own if half is None else math.cos(math.radians(half))
        reach = math.sqrt(1 / self.cosine**2 - 1)
        slopes = (self.own.cell_rays[:2] / self.own.cell_rays[2]).reshape(2, *self.size)
        lines = []
        # Pixels of the wide view are the camera's cells.
        for slope in (slopes[0, 0], slopes[1, :, 0]):
            pitch, first = float(slope.diff().mean()), float(slope[0])
            before, after = ((reach + x) / pitch for x in (first, -float(slope[-1])))
            before, after = (max(0, math.ceil(x)) for x in (before, after))
            lines.append((before, len(slope) + before + after, 1 / pitch, before - first / pitch))
        (self.left, wide, fx, cx), (self.top, high, fy, cy) = lines
        matrix = (fx, 0.0, cx), (0.0, fy, cy), (0.0, 0.0, 1.0)
        # Coarser than what removes them: sharp detail is near, and the camera's own view has it.
        lit = state.model_copy(update={"continued": False, "patch_px": 4})
        self.wide = SecondBounces(CameraIntrinsics(width=wide, height=high, matrix=matrix), lit)

    def cut(self, image: Tensor) -> Tensor:
        """Return the camera's own part of the wide view, (N,)."""
        image = image.reshape(self.wide.rays.shape[1:])[self.top :, self.left :]
        return image[: self.size[0], : self.size[1]].reshape(-1)

    @torch.no_grad()
    def frame(self, draw: Draw) -> Drawn:
        """Draw a scene, and return its frame."""
        shape, rays = self.wide.rays.shape[1:], self.wide.rays.reshape(3, -1)
        while True:
            scene = drawn(draw)
            planes, face, grey = scene.met(rays)
            true = 1 / (planes * rays).sum(0)
            near = self.cut(true)
            filled = float(near.isfinite().double().mean()) > _SCENES["filled"]
            if filled and not bool((near < _SCENES["nearest"]).any()):
                break
        _, _, away, cosine, _ = self.wide.surfaces(planes, rays, rays[0])
        # A face looks the same from behind.
        light = grey * cosine.abs() / (math.pi * self.own.gain * away.square())
        light = torch.where(rays[2] >= self.cosine, light, math.nan)
        planes = scene.met(self.wide.cell_rays)[0]
        known = planes, planes.isfinite().all(0), torch.zeros_like(planes[0]) > 0
        lit = self.wide.added(true.reshape(shape), light.reshape(shape), known=known)
        with_bounces, strength = (self.cut(image) for image in lit)
        a, b, c = self.noise
        sigma = (a + b / strength + c / strength.square()).clamp(min=0).sqrt() / self.own.cell
        measured = with_bounces + sigma * torch.tensor(draw.normal(size=len(sigma)))
        found = self.own.found(measured, strength)
        read = self.network.inputs(*self.own.read(measured, strength, *found))
        return Drawn(read.float(), with_bounces - near - found[0], near, self.cut(face))

    def flat(self, frame: Drawn, left: Tensor) -> Tensor:
        """Return errors (N,) without what moves the plane of each surface; NaN where unknown."""
        moves = (self.own.cell_rays * frame.distance.square()).T
        result, known = torch.full_like(left, math.nan), left.isfinite()
        for number in frame.face[known].unique():
            own = known & (frame.face == number)
            fit = torch.linalg.lstsq(moves[own], left[own, None]).solution
            result[own] = left[own] - (moves[own] @ fit)[:, 0]
        return result


def fit_remainder(
    camera: CameraIntrinsics, state: SecondBouncesState, noise: Noise, options: RemainderOptions
) -> tuple[Remainder, list[float]]:
    """Train a network on drawn scenes, and try it on a fifth of them that it does not see.

    Returns:
        The network; on scenes held out, RMS of what is left without it and with it, millimetres,
        and the same without what moves the plane of each surface: no constant lowers that.
    """
    draw, held_out = np.random.default_rng(options.seed), options.scenes // 5
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(options.seed)
        drawing = Drawing(camera, state, noise, options.width)
        frames, network = [drawing.frame(draw) for _ in range(options.scenes)], drawing.network
        train(network, frames[held_out:], draw)
    squares = []
    for frame in frames[:held_out]:
        with torch.no_grad():
            more = network(frame.read[None])[0].reshape(-1) * frame.distance
        plain = [frame.left, frame.left - more]
        each = torch.stack([*plain, *(drawing.flat(frame, left) for left in plain)])
        squares.append(each.square().nanmean(1))
    return network, (1000 * torch.stack(squares).mean(0).sqrt()).tolist()


def train(network: Remainder, frames: list[Drawn], draw: Draw) -> None:
    """Train in place: least squares up to four times `Remainder.least`, absolute beyond."""
    read = torch.stack([frame.read for frame in frames])
    share = torch.stack([frame.left / frame.distance for frame in frames]).float()
    share = share.reshape(-1, *read.shape[2:])
    ranges = read.amin((0, 2, 3)), read.amax((0, 2, 3)), read.mean((0, 2, 3)), read.std((0, 2, 3))
    held = network.low, network.high, network.mean, network.deviation
    for own, values in zip(held, ranges, strict=True):
        own.data.copy_(values[:, None, None])
    network.bound.data.copy_(share[share.isfinite()].abs().max())
    trained = [one for one in network.parameters() if one.requires_grad]
    rounds, together, fastest = _TRAINING
    optimiser, steps = torch.optim.AdamW(trained, fastest), math.ceil(len(frames) / together)
    rate = torch.optim.lr_scheduler.OneCycleLR(optimiser, fastest, rounds * steps)
    for _ in range(rounds):
        for at in torch.tensor(draw.permutation(len(frames))).chunk(steps):
            x, y = read[at], share[at]
            for axis in (1, 2):  # Mirrored: rows change with n_y, columns with n_x.
                if draw.random() < 0.5:
                    x, y = x.flip(axis + 1), y.flip(axis)
                    x[:, 8 - axis] *= -1
            there = y.isfinite()
            off = (network(x) - y)[there] / (4 * network.least)
            loss = nn.functional.smooth_l1_loss(off, torch.zeros_like(off))
            optimiser.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(trained, 1.0)
            optimiser.step()
            rate.step()
