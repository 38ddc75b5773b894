"""A sample of pixels beside a fitted model: what it leaves, and how its unknowns move that."""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from tofcorr.data.frames import FrameBatch
from tofcorr.data.recording import Recording
from tofcorr.error_terms.base import Term
from tofcorr.estimation.design import Design
from tofcorr.fit.result import Fit
from tofcorr.fit.walls import name_walls
from tofcorr.geometry.planes import tangents
from tofcorr.pixels.dataset import Dataset
from tofcorr.pixels.sample import distance_to_plane, thinned

# Frames that are read at most, evenly spread. Chosen: as many determine fifty unknowns well.
_MOST_FRAMES = 200
# Pixels looked at in all, and the limits for one frame. Measured: with 200 of each of 40 frames a
# focal length 1.5 % off is found with p = 1e-3 to 1e-10, with 400 with 1e-6 to 1e-16; these take
# 0.07 s, twice as many 0.11 s.
_ALL_PIXELS = 16_000
_MOST, _LEAST = 400, 80
# Cosine of the angle of incidence below which a pixel is left out, no unit: what is computed from
# the geometry grows without bounds there. Chosen: 80 degrees.
_GRAZING = 0.17


@dataclass(frozen=True, eq=False)
class _Pixels:
    """See `MisfitPixels`."""

    frame: Tensor
    residual: Tensor
    jacobian: Tensor
    weight: Tensor
    cosine: Tensor
    distance: Tensor
    ray: Tensor
    normal: Tensor
    world: Tensor
    on_wall: Tensor
    amplitude: Tensor
    before: Tensor
    amplitude_before: Tensor


@dataclass(frozen=True, eq=False)
class MisfitPixels(_Pixels):
    """M pixels of F frames beside a model of P unknowns.

    Attributes:
        frame: Place of each pixel's frame among those looked at, shape (M,).
        residual: Signed distance of the corrected point to its plane, shape (M,), metres.
        jacobian: Its derivatives by a step of `Parameters.moved`, then by the walls if they were
            estimated, shape (M, P). The error terms are taken at the distance that the camera
            should measure: that has no noise, which the residual has as well.
        weight: Of each pixel in the fit, shape (M,).
        cosine: Between ray and normal, shape (M,), negative: the change of the residual with the
            measured distance.
        distance: To the plane along the ray, shape (M,), metres.
        ray: Unit rays in the camera frame, shape (M, 3).
        normal: Of the planes in the camera frame, shape (M, 3).
        world: Where the rays meet the planes in the world, shape (M, 3), metres.
        on_wall: The same along two directions of the wall, from its middle, shape (M, 2), metres.
        amplitude: Shape (M,); NaN where none was recorded.
        before: What the same pixel measured in the frame before, shape (M,), metres; NaN: nothing.
        amplitude_before: Its amplitude there, shape (M,); NaN: unknown.
        pose: The pose of each frame, shape (F,), counted from zero.
        depth_kind: Of the recording: an error of a ray leaves the depth as it was stored.
        modulation_frequency: Hz; None if unknown.
        walls_estimated: Whether the walls were estimated with the rest.
    """

    pose: Tensor
    depth_kind: str
    modulation_frequency: float | None
    walls_estimated: bool


def misfit_pixels(data: Dataset, fit: Fit, frames: np.ndarray) -> MisfitPixels | None:
    """Read some pixels of some frames, the same ones at each call.

    Args:
        data: The recordings, with the walls of the fit.
        fit: The fitted model.
        frames: Global numbers of the frames, increasing.

    Returns:
        The pixels; None if no ray meets its wall, which a fit that went astray has turned away.
    """
    chosen = thinned(frames, _MOST_FRAMES)
    number = int(np.clip(_ALL_PIXELS // len(chosen), _LEAST, _MOST))
    reader = _Reader(data, fit, number)
    generator = torch.Generator().manual_seed(0)
    parts: list[_Pixels] = []
    for recording, start, local in data.by_recording(chosen):
        for batch in data.batches(start + local):
            left = distance_to_plane(fit.model, batch, data.ray_directions())
            parts += [
                reader.pixels(recording, start, batch, left, k, generator)
                for k in range(len(batch.indices))
            ]
    counts = torch.tensor([len(part.residual) for part in parts])
    joined = {name: torch.cat([vars(part)[name] for part in parts]) for name in vars(parts[0])}
    if not len(joined["residual"]):
        return None
    joined["frame"] = torch.arange(len(parts)).repeat_interleave(counts)
    joined["on_wall"] = _from_middle(joined["on_wall"])
    return MisfitPixels(
        **joined,
        pose=torch.from_numpy(np.unique(data.pose_groups()[chosen], return_inverse=True)[1]),
        depth_kind=data.first.depth_kind,
        modulation_frequency=data.first.modulation_frequency,
        walls_estimated=fit.walls is not None,
    )


class _Reader:
    """Computes the pixels of one frame after another."""

    def __init__(self, data: Dataset, fit: Fit, number: int) -> None:
        self._data, self._fit, self._number = data, fit, number
        self._rays = data.ray_directions()
        self._model = fit.model.error
        self._design = Design(self._model, fit.domain, self._rays)
        self._hand_eye = fit.solution.parameters.tool_from_camera
        self._wall = None if fit.walls is None else torch.from_numpy(name_walls(data).of_frame)

    def pixels(
        self,
        recording: Recording,
        start: int,
        batch: FrameBatch,
        left: Tensor,
        k: int,
        generator: torch.Generator,
    ) -> _Pixels:
        """Return some pixels of one frame.

        Args:
            recording: That of the frame.
            start: Global number of its first frame.
            batch: Frames of it.
            left: Distances of their points to the planes, shape (B, H, W).
            k: Which of them.
            generator: Picks the pixels.
        """
        local = int(batch.indices[k]) - start
        table, hand_eye = recording.frames, self._hand_eye
        normal = batch.normal_tool[k] @ hand_eye[:3, :3]
        offset = batch.normal_tool[k] @ hand_eye[:3, 3] + batch.offset_tool[k]
        facing = self._rays.reshape(-1, 3) @ normal
        seen = batch.valid[k].reshape(-1) & (facing < -_GRAZING)
        some = seen.nonzero()[:, 0]
        some = some[torch.randperm(len(some), generator=generator)[: self._number]]
        ray, cosine = self._rays.reshape(-1, 3)[some], facing[some]
        distance = -offset / cosine
        measured = batch.radial_distance[k].reshape(-1)[some]
        amplitude = _flat(batch.amplitude, k, some)
        residual = left[k].reshape(-1)[some]
        # What the camera should measure: the distance to the plane and its own error.
        noiseless = measured - residual / cosine
        columns = self._functions(batch, k, some, noiseless, amplitude)
        points = ray * distance[:, None]
        normals = normal.expand(len(some), 3)
        world_from_camera = torch.from_numpy(table.world_from_tool[local]) @ hand_eye
        world = points @ world_from_camera[:3, :3].T + world_from_camera[:3, 3]
        across = tangents(torch.from_numpy(table.normal_world[local]))
        turned = torch.linalg.cross(points, normals)
        own = torch.cat([normals, turned, -cosine[:, None] * columns.T], dim=1)
        before = local - 1 if local else None
        return _Pixels(
            frame=some,
            residual=residual,
            jacobian=torch.cat([own, self._by_walls(batch.indices[k], world @ across.T)], dim=1),
            weight=_weight(self._fit, batch, k, some),
            cosine=cosine,
            distance=distance,
            ray=ray,
            normal=normals,
            world=world,
            on_wall=world @ across.T,
            amplitude=amplitude,
            before=_distance_at(recording, before, some, ray),
            amplitude_before=_image_at(recording.amplitude, before, some),
        )

    def _functions(
        self, batch: FrameBatch, k: int, some: Tensor, distance: Tensor, amplitude: Tensor
    ) -> Tensor:
        """Return what the coefficients multiply, at some measured distances, shape (K, M)."""
        design = self._design
        known = amplitude if self._data.has_amplitude else torch.ones_like(distance)
        pixel = design.pixel_functions.flatten(1)[:, some][design.pixel]
        signal = design.signal_functions(distance, known)[design.signal]
        terms: list[Term] = list(self._model.condition_terms)  # type: ignore[arg-type]
        assert batch.conditions is not None
        of_frame = [term.basis(batch.conditions[k : k + 1]) for term in terms]  # type: ignore[operator]
        return torch.cat([(signal * pixel)[1:], *(part.expand(-1, len(some)) for part in of_frame)])

    def _by_walls(self, frame: Tensor, on_wall: Tensor) -> Tensor:
        """Return the derivatives by two turns and a shift of each estimated wall, (M, 3 W)."""
        if self._wall is None:
            return on_wall.new_zeros(len(on_wall), 0)
        found = on_wall.new_zeros(len(on_wall), int(self._wall.max()) + 1, 3)
        found[:, self._wall[frame], :2] = on_wall
        found[:, self._wall[frame], 2] = 1.0
        return found.flatten(1)


def _flat(images: Tensor | None, k: int, some: Tensor) -> Tensor:
    if images is None:
        return torch.full((len(some),), torch.nan, dtype=torch.float64)
    return images[k].reshape(-1)[some]


def _weight(fit: Fit, batch: FrameBatch, k: int, some: Tensor) -> Tensor:
    if fit.weights is None:
        return torch.ones(len(some), dtype=torch.float64)
    return fit.weights(batch)[k].reshape(-1)[some]


def _image_at(images: np.ndarray | None, frame: int | None, some: Tensor) -> Tensor:
    """Return some pixels of one frame of an array; NaN without array or frame."""
    if images is None or frame is None:
        return torch.full((len(some),), torch.nan, dtype=torch.float64)
    return torch.from_numpy(images[frame].reshape(-1)[some.numpy()].astype(np.float64))


def _distance_at(recording: Recording, frame: int | None, some: Tensor, ray: Tensor) -> Tensor:
    """Return what some pixels of one frame measured along their rays; NaN where nothing."""
    depth = _image_at(recording.depth, frame, some)
    depth = torch.where(depth > 0, depth, torch.nan)
    return depth / ray[:, 2] if recording.depth_kind == "z" else depth


def _from_middle(on_wall: Tensor) -> Tensor:
    return on_wall - on_wall.median(dim=0).values
