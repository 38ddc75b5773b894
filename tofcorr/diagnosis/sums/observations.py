r"""The pixels of a recording that a diagnosis uses, and what geometry predicts of them.

Pixels are flattened frame by frame. Distances and other inputs of effects follow from poses, planes
and the hand-eye transform.

Planes that an importer found in the depth are nuisance parameters. An estimated plane has absorbed
part of the camera's errors. The diagnosis therefore fits every such wall again, together with
hand-eye transform and error terms, in the base fit, in each fold and beside each effect. A wall
n . x + d = 0 has three parameters: two turns of its normal and a shift of d. For a point p, seen
along the ray r, the predicted distance D changes by

.. math:: \frac{\partial D}{\partial a} = -\frac{t \cdot p}{n \cdot r}, \quad
          \frac{\partial D}{\partial d} = -\frac{1}{n \cdot r}

with the normal's tangent vector t.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from tofcorr.conditions import CONDITIONS
from tofcorr.data.recording import Recording, iterate_frames, pose_numbers
from tofcorr.error_terms.model import Pixels
from tofcorr.errors import CalibrationDataError
from tofcorr.fit.walls import name_walls
from tofcorr.geometry import se3
from tofcorr.geometry.rays import ray_directions, ray_plane_distance, tangents
from tofcorr.geometry.se3 import by_frame
from tofcorr.pixels.dataset import Dataset
from tofcorr.simulation.effects.base import EffectInputs
from tofcorr.simulation.hooks import FrameFacts
from tofcorr.simulation.simulator import facts_of


def even_order(height: int, width: int) -> Tensor:
    """Return the order in which the pixels of an image are chosen, flat indices (H W,), int64.

    The first ones of any number are spread evenly, and are the same in all frames: an error of each
    pixel of its own shows only in a pixel that several poses see. Multiples of the inverse of the
    plastic ratio, the real root of x^3 + x^2 = 1, and of its square fill the square most evenly, as
    those of the golden ratio fill a line (Roberts 2018, "The unreasonable effectiveness of
    quasirandom sequences").
    """
    plastic = float(np.roots([1, 1, 0, -1])[-1].real)
    rows, columns = torch.arange(height)[:, None], torch.arange(width)
    place = (rows * plastic + columns * plastic**2).remainder(1.0)
    return place.reshape(-1).argsort(stable=True)


TINY = float(torch.finfo(torch.float32).tiny)
"""Least divisor: keeps quotients of nothing by nothing finite."""


@dataclass(frozen=True, kw_only=True)
class Observations:
    """The M chosen pixels of all frames, in the order of the frames.

    Attributes:
        recording: Where they come from.
        facts: Poses, planes and conditions of the frames.
        frame: Frame of each pixel, shape (M,), int64.
        pixel: Flat index in the image, shape (M,), int64.
        measured: Radial distance, shape (M,), metres.
        amplitude: Shape (M,), counts; None if not recorded.
        amplitude_images: Shape (F, H, W), float32, zero without a return; None if not recorded.
        distance_images: Measured radial distances, shape (F, H, W), float32, zero without a
            return.
        on_target: Where the image shows the target, shape (F, H, W), bool.
        unit: Pose of each frame, shape (F,), int64: frames taken without moving share one.
        wall: The wall that each frame shows, shape (F,), int64, where planes are estimated; None
            where they were measured.
        num_walls: How many walls have estimated planes: 0 where they were measured.
        is_sample: Whether some of the usable pixels were chosen, as of large images.
    """

    recording: Recording
    facts: FrameFacts
    frame: Tensor
    pixel: Tensor
    measured: Tensor
    amplitude: Tensor | None
    amplitude_images: Tensor | None
    distance_images: Tensor
    on_target: Tensor
    unit: Tensor
    wall: Tensor | None = None
    num_walls: int = 0
    is_sample: bool = False

    @property
    def num_frames(self) -> int:
        """Number of frames."""
        return len(self.unit)

    @cached_property
    def num_units(self) -> int:
        """Number of poses."""
        return int(self.unit.max()) + 1

    @property
    def usable(self) -> Tensor:
        """Which pixels of the images show the target at a distance, bool, shape (F, H, W)."""
        return self.on_target & (self.distance_images > 0)

    @cached_property
    def density(self) -> float:
        """Share of the pixels on the target that were chosen, at most 1."""
        return min(len(self.pixel) / max(int(self.on_target.sum()), 1), 1.0)

    @cached_property
    def frame_ends(self) -> list[tuple[int, int]]:
        """Where the pixels of each frame begin and end."""
        counts = torch.bincount(self.frame, minlength=self.num_frames)
        ends = torch.cumsum(counts, 0)
        return list(zip((ends - counts).tolist(), ends.tolist(), strict=True))

    @cached_property
    def rays(self) -> Tensor:
        """Unit viewing rays of the pixels in the camera frame, shape (M, 3)."""
        # In memory one coordinate follows the other: elementwise operations are fastest so.
        return ray_directions(self.recording.camera).reshape(-1, 3).T[:, self.pixel].T

    def per_pose(self, values: Tensor) -> Tensor:
        """Return the sums of values (M,) over the pixels of each pose, shape (U,)."""
        return torch.bincount(self.unit[self.frame], values, self.num_units)

    def term_inputs(self, distance: Tensor) -> Pixels:
        """Return what error terms depend on, at distances (M,), metres.

        An amplitude that was not recorded is zero: no term reads it.
        """
        amplitude = torch.zeros_like(distance) if self.amplitude is None else self.amplitude
        width, conditions = self.recording.camera.width, self.conditions[self.frame]
        row, column = (self.pixel // width).double(), (self.pixel % width).double()
        return Pixels(distance, amplitude, row, column, conditions)

    def products(self, left: Tensor, right: Tensor) -> Tensor:
        """Return the sums of products of values (M, J) and (M, K) over each pose, (U, J, K)."""
        sums = np.zeros((self.num_units, left.shape[1], right.shape[1]))
        # NumPy's products of few columns take a quarter of the time of torch's.
        rows, columns = left.numpy().T, right.numpy()
        for unit, (start, end) in zip(self.unit.tolist(), self.frame_ends, strict=True):
            sums[unit] += rows[:, start:end] @ columns[start:end]
        return torch.from_numpy(sums)

    @property
    def conditions(self) -> Tensor:
        """The frames' conditions in the order of `CONDITIONS`, (F, C); NaN: unknown."""
        unknown = torch.full((self.num_frames,), torch.nan, dtype=torch.float64)
        columns = [getattr(self.facts, name) for name in CONDITIONS]
        return torch.stack([unknown if c is None else c.double() for c in columns], dim=1)

    def choosing(self, frame: Tensor, pixel: Tensor) -> "Observations":
        """Return other pixels of the same images: their frames and flat indices, (M,), in order."""
        amplitude = None
        if self.amplitude_images is not None:
            amplitude = self.amplitude_images.flatten(1)[frame, pixel].double()
        measured = self.distance_images.flatten(1)[frame, pixel].double()
        return replace(self, frame=frame, pixel=pixel, measured=measured, amplitude=amplitude)

    def at(self, pixels: Tensor | slice) -> "Observations":
        """Return some of the pixels; images stay whole.

        Args:
            pixels: Which ones, in their order: a slice, or bool of shape (M,).
        """
        known = {name: getattr(self, name) for name in ("frame", "pixel", "measured", "amplitude")}
        return replace(self, **{n: own[pixels] for n, own in known.items() if own is not None})


def observe(recording: Recording, most_pixels: int) -> Observations:
    """Read a recording and choose its pixels.

    Args:
        recording: What to diagnose.
        most_pixels: More usable pixels are thinned out evenly, to the same places in all frames; 64
            of a frame are kept, however many frames there are.

    Raises:
        CalibrationDataError: Fewer than two frames hold usable pixels.
    """
    budget = max(64, most_pixels // recording.num_frames)
    order = even_order(recording.camera.height, recording.camera.width)
    chosen, images, distances, masks, most = [], [], [], [], 0
    for batch in iterate_frames(recording, image_dtype=torch.float32):
        everywhere = batch.radial_distance.nan_to_num(0.0, 0.0, 0.0).clamp(min=0.0)
        distances.append(everywhere)
        if batch.amplitude is not None:
            known = batch.amplitude.nan_to_num(0.0, 0.0, 0.0)
            images.append(torch.where(everywhere > 0, known, 0.0))
        mask = recording.read("mask", batch.indices.numpy())
        masks.append(torch.ones_like(batch.valid) if mask is None else torch.from_numpy(mask) > 0)
        most = max(most, int(batch.valid.flatten(1).sum(1).max()))
        chosen += [order[own[order]][:budget].sort().values for own in batch.valid.flatten(1)]
    counts = torch.tensor([len(own) for own in chosen])
    if (seen := int((counts > 0).sum())) < 2:
        raise CalibrationDataError(
            f"{recording.path}: a diagnosis needs two frames with usable pixels, got {seen}."
        )
    every = Observations(
        recording=recording,
        facts=facts_of(recording),
        frame=counts,
        pixel=counts,
        measured=counts,
        amplitude=None,
        amplitude_images=torch.cat(images) if images else None,
        distance_images=torch.cat(distances),
        on_target=torch.cat(masks),
        unit=torch.from_numpy(pose_numbers(recording)),
        is_sample=most > budget,
    )
    return every.choosing(torch.arange(len(chosen)).repeat_interleave(counts), torch.cat(chosen))


def small_tiles(observations: Observations, *, per_tile: float = 12.0) -> dict[str, Tensor]:
    """Return the tile of every pixel, (M,), int64, for squares, pieces of rows and of columns.

    Args:
        observations: The pixels.
        per_tile: Mean number of pixels in a tile. Chosen: enough pairs, yet smaller than the
            patterns of effects.
    """
    width, pixel = observations.recording.camera.width, observations.pixel
    row, column = pixel // width, pixel % width
    area = per_tile / observations.density
    side, length = max(2, round(area**0.5)), max(2, round(area))
    return {
        "squares": row // side * width + column // side,
        "rows": row * width + column // length,
        "columns": row // length * width + column,
    }


def frame_chunks(observations: Observations, most_pixels: int = 500_000) -> Iterator[slice]:
    """Yield frames of whole images, so many pixels at a time that memory is bounded."""
    step = max(1, most_pixels // observations.on_target[0].numel())
    for start in range(0, observations.num_frames, step):
        yield slice(start, start + step)


def predicted_distance(observations: Observations, tool_from_camera: Tensor) -> Tensor:
    """Return the distance of the plane along the ray of each chosen pixel, shape (M,), metres."""
    return seen_points(observations, tool_from_camera)[0]


def seen_points(
    observations: Observations, tool_from_camera: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Return where the ray of each chosen pixel meets its plane.

    Returns:
        The distance, (M,), metres; the product of ray and normal, which is minus the cosine of the
        incidence, (M,); and the point in the world, (M, 3), metres.
    """
    frame, rays = observations.frame, observations.rays
    normal, offset = observations.facts.planes_seen(tool_from_camera)
    slope = by_frame(rays, normal[:, :, None], frame)[:, 0]
    distance = -offset[frame] / slope
    pose = observations.facts.world_from_tool @ tool_from_camera
    points = by_frame(rays, pose[:, :3, :3].mT, frame) * distance[:, None] + pose[frame, :3, 3]
    return distance, slope, points


def hand_eye_columns(observations: Observations, tool_from_camera: Tensor) -> tuple[Tensor, Tensor]:
    """Return the predicted distance, (M,), and its derivative by the hand-eye twist, (M, 6).

    The twist acts from the right, tool_from_camera exp(twist), translation first.
    """
    planes, offset = observations.facts.planes_seen(tool_from_camera)
    # One vector of all pixels after another: elementwise operations are fastest so.
    normal, rays = planes.T[:, observations.frame], observations.rays.T.contiguous()
    # A camera that moves by t and turns by w changes its height over the plane by n . t, and the
    # slope s = n . ray by -(w x n) . ray; the distance is -height / s.
    slope = (rays * normal).sum(0)
    distance = -offset[observations.frame] / slope
    by_rotation = torch.linalg.cross(normal, rays, dim=0) * (distance / slope)
    return distance, torch.cat([-normal / slope, by_rotation]).T


def effect_inputs(observations: Observations, tool_from_camera: Tensor) -> EffectInputs:
    """Return what effects may depend on: predicted geometry, measured amplitude."""
    facts, frame = observations.facts, observations.frame
    distance, slope, points = seen_points(observations, tool_from_camera)
    target_from_world = se3.inverse(se3.world_from_plane(facts.normal_world, facts.offset))
    target_xy = by_frame(points, target_from_world[:, :2, :3].mT, frame)
    chunks = frame_chunks(observations)
    images = [distance_images(observations, tool_from_camera, c).float() for c in chunks]
    return EffectInputs(
        camera=observations.recording.camera,
        modulation_frequency=observations.recording.modulation_frequency,
        tool_from_camera=tool_from_camera,
        facts=facts,
        frame=frame,
        pixel=observations.pixel,
        rays=observations.rays,
        radial_distance=distance,
        incidence_cosine=-slope,
        points_world=points,
        target_xy=target_xy + target_from_world[frame, :2, 3],
        amplitude=observations.amplitude,
        amplitude_images=observations.amplitude_images,
        distance_images=torch.cat(images),
        planes_are_measured=observations.wall is None,
    )


def distance_images(
    observations: Observations, tool_from_camera: Tensor, part: slice | Tensor
) -> Tensor:
    """Return predicted distances on the target and measured ones elsewhere, of some frames."""
    predicted = predicted_images(observations, tool_from_camera, part)
    use = observations.on_target[part] & predicted.isfinite()
    return torch.where(use, predicted, observations.distance_images[part].double())


def predicted_images(
    observations: Observations,
    tool_from_camera: Tensor,
    part: slice | Tensor,
    rows: slice = slice(None),
) -> Tensor:
    """Return the distance of the plane in all pixels of some frames and rows; NaN where none."""
    normal, offset = (x[part] for x in observations.facts.planes_seen(tool_from_camera))
    return ray_plane_distance(ray_directions(observations.recording.camera)[rows], normal, offset)


def with_numbered_walls(observations: Observations) -> Observations:
    """Return the observations that know which wall each frame shows, where planes are estimated.

    Recorded planes that were measured stay as they are: no wall is numbered. A wall has three
    parameters, and one pose determines about three: fewer than three poses, as in training, tell
    hardly anything but where the wall is.

    Raises:
        CalibrationDataError: The planes are estimated, and no robot moves, or a wall is seen from
            fewer than three poses.
    """
    recording = observations.recording
    if recording.planes != "estimated":
        return observations
    if not recording.moves:
        raise CalibrationDataError(
            f"{recording.path}: its planes are estimated from the depth (recording.yaml: planes) "
            "and no robot moves: nothing but the depth itself says where they are. Measure them, "
            "or import a checkerboard."
        )
    of_frame, names = name_walls(Dataset((recording,)))
    wall = torch.from_numpy(of_frame)
    seen = observations.frame.unique()
    for number, name in enumerate(names):
        poses = len(observations.unit[seen][wall[seen] == number].unique())
        if poses < 3:
            raise CalibrationDataError(
                f"{recording.path}: its planes are estimated from the depth (recording.yaml: "
                f"planes), and '{name}' is seen from {poses} pose{'s' * (poses != 1)}; 3 are "
                "needed to estimate it anew. Record more, or leave its frames out."
            )
    return replace(observations, wall=wall, num_walls=len(names))


def wall_columns(observations: Observations, tool_from_camera: Tensor) -> Tensor:
    """Return the derivative of the predicted distance by the G walls' parameters, (M, 3G)."""
    wall, frame = observations.wall, observations.frame
    assert wall is not None
    _, slope, points = seen_points(observations, tool_from_camera)
    across = by_frame(points, tangents(observations.facts.normal_world).mT, frame)
    own = -torch.cat([across, torch.ones_like(across[:, :1])], dim=1) / slope[:, None]
    shown = torch.nn.functional.one_hot(wall[frame], observations.num_walls)
    return (shown[:, :, None] * own[:, None]).flatten(1)


def with_walls_moved(observations: Observations, step: Tensor) -> Observations:
    """Return the observations after a step (3G,) of the walls; recording and facts both follow.

    Each wall has two turns, radians, and a shift, metres.
    """
    wall, facts = observations.wall, observations.facts
    if wall is None:
        return observations
    change = step.reshape(observations.num_walls, -1)[wall]
    turned = facts.normal_world + (change[:, :2, None] * tangents(facts.normal_world)).sum(1)
    normal = torch.nn.functional.normalize(turned, dim=1)
    moved = replace(facts, normal_world=normal, offset=facts.offset + change[:, 2])
    return with_planes(observations, moved)


def with_planes(observations: Observations, facts: FrameFacts) -> Observations:
    """Return the observations with the planes of other facts about the same frames."""
    if observations.wall is None:
        return observations
    planes = {"normal_world": facts.normal_world, "offset": facts.offset}
    table = replace(observations.recording.frames, **{k: v.numpy() for k, v in planes.items()})
    recording = replace(observations.recording, frames=table)
    return replace(observations, facts=replace(observations.facts, **planes), recording=recording)
