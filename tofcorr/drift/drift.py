r"""Whether a calibration still holds, from a few frames of any wall.

A camera that has drifted reads too far by some :math:`\delta` along every ray. After correction
the distance of a pixel to its wall is then

.. math:: r_v = g_v \delta + \text{(what the wall's unknown place explains)} + \text{noise},
    \quad g_v = n \cdot a_v

with the wall's normal n towards the camera and the ray :math:`a_v`. Whatever a displaced or turned
wall would explain is projected out of both sides first, so that :math:`\delta` is not mistaken for
it. Little is left of g for a wall that is unknown in every image (the curvature of a shifted plane
alone), and everything for a known one.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np
import torch
from scipy import stats
from torch import Tensor

from tofcorr.correction.state import CalibrationState
from tofcorr.data.frames import FrameBatch
from tofcorr.error_terms.model import ErrorModel, Pixels
from tofcorr.errors import CalibrationDataError
from tofcorr.geometry.planes import plane_in_frame, tangents
from tofcorr.pixels.dataset import Dataset
from tofcorr.pixels.walls import OffTheWall, image_planes

Wall = Literal["per_image", "one", "recorded"]
Verdict = Literal["holds", "drifted", "undecided"]

_LEVEL = 0.95
_FEWEST_PIXELS = 50
# Side of the blocks of pixels whose means show a departure from the plane beneath the noise.
_BLOCK = 8


class Image(NamedTuple):
    """One image after correction.

    Attributes:
        frame: Its number.
        residual: Distances to the assumed wall, shape (M,), metres.
        gain: What an offset along the ray adds to them, shape (M,).
        nuisance: What a displaced or turned wall adds, shape (M, 3): in world axes where one wall
            is shared by all images.
        basis: What each coefficient adds, shape (M, K).
        block: Which block of the image each pixel lies in, shape (M,).
    """

    frame: int
    residual: Tensor
    gain: Tensor
    nuisance: Tensor
    basis: Tensor
    block: Tensor


@dataclass(frozen=True)
class DriftCheck:
    """The finding.

    Attributes:
        verdict: `holds`: an offset beyond the threshold is excluded; `drifted`: it is certain, or
            the corrected wall is not flat; `undecided`: these images do not tell.
        wall: What was assumed of the wall.
        offset: How much farther than at calibration the camera reads, metres.
        interval: Its 95 % interval, metres.
        flatness: Root mean square departure of the corrected walls from planes, beneath the
            noise, metres.
        threshold: What counts as drift, metres.
        images: Each image's frame number, departure from flatness (metres) and pixels used.
        outside: Share of the pixels outside the calibrated range, which were not used.
    """

    verdict: Verdict
    wall: Wall
    offset: float
    interval: tuple[float, float]
    flatness: float
    threshold: float
    images: list[tuple[int, float, int]]
    outside: float


def check_drift(
    state: CalibrationState, dataset: Dataset, wall: Wall = "per_image", threshold: float = 5e-3
) -> DriftCheck:
    """Measure how far a camera reads from what it read when it was calibrated.

    Pixels off the wall or outside the calibrated range are left out.

    Args:
        state: The calibration.
        dataset: The new frames, of the same camera.
        wall: `recorded`: planes and robot poses are trusted; `one`: all images show one wall that
            stands somewhere, the robot's poses are trusted; `per_image`: nothing is known.
        threshold: What counts as drift, metres.

    Raises:
        CalibrationDataError: The camera is another one, no image has enough usable pixels, or one
            wall is asked for and no robot moves.
    """
    _refuse_other_camera(state, dataset)
    if wall == "one" and not dataset.moves:
        raise CalibrationDataError(
            f"{dataset.first.path}: one wall seen from several poses needs a robot's poses in "
            "frames.csv, and there none changes; use the plane per image, or the recorded one."
        )
    counts = np.zeros(2)
    images = list(_images(state, dataset, wall, counts))
    if not images:
        raise CalibrationDataError(
            f"{dataset.first.path}: no image has {_FEWEST_PIXELS} usable pixels on a wall within "
            "the calibrated ranges of distance and amplitude; record a wall there."
        )
    offset, error, freedom = _offset(state, images, wall)
    half = float(stats.t.ppf((1 + _LEVEL) / 2, freedom)) * error
    departures = [_departure(image) for image in images]
    flatness = math.sqrt(sum(value**2 for value in departures) / len(departures))
    return DriftCheck(
        verdict=_verdict(offset, half, flatness, threshold),
        wall=wall,
        offset=offset,
        interval=(offset - half, offset + half),
        flatness=flatness,
        threshold=threshold,
        images=[
            (image.frame, departure, len(image.residual))
            for image, departure in zip(images, departures, strict=True)
        ],
        outside=float(1 - counts[1] / max(counts[0], 1)),
    )


def _verdict(offset: float, half: float, flatness: float, threshold: float) -> Verdict:
    if abs(offset) - half > threshold or flatness > threshold:
        return "drifted"
    return "holds" if abs(offset) + half <= threshold else "undecided"


def _refuse_other_camera(state: CalibrationState, dataset: Dataset) -> None:
    first = dataset.first
    if first.camera != state.camera or first.depth_kind != state.depth_kind:
        raise CalibrationDataError(
            f"{first.path}: this is not the camera that was calibrated: expected "
            f"{state.camera.width}x{state.camera.height} pixels, depth_kind {state.depth_kind} and "
            "the same K and distortion."
        )


def _images(
    state: CalibrationState, dataset: Dataset, wall: Wall, counts: np.ndarray
) -> Iterator[Image]:
    """Correct the images; `counts` adds up pixels on walls, and those in the calibrated range."""
    rays = dataset.ray_directions()
    model, off = state.model(), OffTheWall(rays)
    # Without a robot the recorded planes are in the camera's own coordinates.
    hand_eye = state.tool_from_camera if dataset.moves else torch.eye(4, dtype=torch.float64)
    poses = torch.cat(
        [torch.from_numpy(recording.frames.world_from_tool) for recording in dataset.recordings]
    )
    for batch in dataset.batches():
        on_wall = batch.valid & ~off(batch)
        inside = on_wall & _calibrated(state, batch)
        counts += np.array([float(on_wall.sum()), float(inside.sum())])
        corrected = _corrected(model.error, batch, inside)
        planes = image_planes(corrected, rays)
        for k, frame in enumerate(batch.indices.tolist()):
            used = inside[k].flatten().nonzero()[:, 0]
            if len(used) < _FEWEST_PIXELS:
                continue
            normal, offset = planes.normal[k], planes.offset[k]
            if wall != "per_image":
                normal, offset = plane_in_frame(
                    batch.normal_tool[k], batch.offset_tool[k], hand_eye
                )
            direction = rays.flatten(0, 1)[used]
            points = direction * corrected.radial_distance[k].flatten()[used, None]
            gain = direction @ normal
            towards = points
            if wall == "one":
                camera = poses[frame] @ hand_eye
                towards = points @ camera[:3, :3].T + camera[:3, 3]
                normal_world = camera[:3, :3] @ normal
                across = tangents(normal_world)
            else:
                across = tangents(normal)
            ones = torch.ones_like(gain)[:, None]
            yield Image(
                frame=frame,
                residual=points @ normal + offset,
                gain=gain,
                nuisance=torch.cat([towards @ across.T, ones], dim=1),
                basis=-gain[:, None] * _basis(model.error, batch, k, used),
                block=_blocks(used, rays.shape[1]),
            )


def _calibrated(state: CalibrationState, batch: FrameBatch) -> Tensor:
    """Return where distance and amplitude lie within what was calibrated."""
    low, high = state.domain.radial_distance
    inside = (batch.radial_distance >= low) & (batch.radial_distance <= high)
    if state.domain.amplitude is not None and batch.amplitude is not None:
        low, high = state.domain.amplitude
        inside &= (batch.amplitude >= low) & (batch.amplitude <= high)
    return inside


def _pixels(batch: FrameBatch, k: int, used: Tensor) -> Pixels:
    width = batch.valid.shape[2]
    distance = batch.radial_distance[k].flatten()[used]
    amplitude = distance if batch.amplitude is None else batch.amplitude[k].flatten()[used]
    assert batch.conditions is not None
    rows, columns = (used // width).to(distance), (used % width).to(distance)
    return Pixels(distance, amplitude, rows, columns, batch.conditions[k].expand(len(used), -1))


@torch.no_grad()
def _basis(error: ErrorModel, batch: FrameBatch, k: int, used: Tensor) -> Tensor:
    return error.columns_at(_pixels(batch, k, used)).T


@torch.no_grad()
def _corrected(error: ErrorModel, batch: FrameBatch, inside: Tensor) -> FrameBatch:
    """Return the batch with corrected distances, valid where `inside`."""
    distance = batch.radial_distance.clone()
    for k in range(len(distance)):
        used = inside[k].flatten().nonzero()[:, 0]
        pixels = _pixels(batch, k, used)
        predicted = error.coefficient_vector() @ error.columns_at(pixels)
        predicted = predicted + error.pattern_at(pixels) + error.residual_at(pixels)
        flat = distance[k].flatten()
        flat[used] -= predicted
        distance[k] = flat.view(distance.shape[1:])
    return replace(batch, radial_distance=distance, valid=inside)


def _blocks(used: Tensor, width: int) -> Tensor:
    across = -(-width // _BLOCK)
    return (used // width // _BLOCK) * across + used % width // _BLOCK


def _offset(state: CalibrationState, images: list[Image], wall: Wall) -> tuple[float, float, int]:
    """Return the offset, its standard error and the degrees of freedom.

    The offset is positive where the camera reads too far: then r = g delta with g the ray's
    component along the normal (negative), as the corrected point lies behind the wall.
    """
    groups = [images] if wall == "one" else [[image] for image in images]
    scores, weights, leverages = [], [], []
    for group in groups:
        residual = torch.cat([image.residual for image in group])
        gain = torch.cat([image.gain for image in group])
        basis = torch.cat([image.basis for image in group])
        if wall != "recorded":
            nuisance = torch.cat([image.nuisance for image in group])
            residual, gain, basis = _without(nuisance, residual, gain, basis)
        start = 0
        for image in group:
            part = slice(start, start + len(image.gain))
            start = part.stop
            scores.append(float(gain[part] @ residual[part]))
            weights.append(float(gain[part] @ gain[part]))
            leverages.append(gain[part] @ basis[part])
    score, weight = np.array(scores), np.array(weights)
    offset = float(score.sum() / weight.sum())
    apart = score - offset * weight
    count = len(images)
    variance = count / max(count - 1, 1) * float((apart**2).sum()) / weight.sum() ** 2
    if count == 1:
        image = images[0]
        left = image.residual - image.residual.mean()
        variance = float(left.square().mean()) / weight.sum()
    if wall != "recorded" and state.covariance is not None:
        # Where the wall is unknown, an error of the calibrated shape passes for an offset.
        leverage = torch.stack(leverages).sum(dim=0) / weight.sum()
        known = state.covariance[: len(leverage), : len(leverage)]
        variance += float(leverage @ known @ leverage)
    return offset, math.sqrt(variance), max(count - 1, 1)


def _without(nuisance: Tensor, *columns: Tensor) -> tuple[Tensor, ...]:
    """Project nuisance (M, 3) out of vectors (M,) and matrices (M, K)."""
    q = torch.linalg.qr(nuisance).Q
    return tuple(column - q @ (q.T @ column) for column in columns)


def _departure(image: Image) -> float:
    """Return how far the corrected wall departs from a plane beneath the noise, metres."""
    (residual,) = _without(image.nuisance, image.residual)
    blocks, place = torch.unique(image.block, return_inverse=True)
    count = torch.bincount(place, minlength=len(blocks)).to(residual)
    mean = torch.zeros(len(blocks)).to(residual).index_add_(0, place, residual) / count
    spread = (
        torch.zeros(len(blocks))
        .to(residual)
        .index_add_(0, place, (residual - mean[place]).square())
    )
    enough = count >= 4
    if not bool(enough.any()):
        return 0.0
    # The mean of n pixels scatters by their variance over n even where the wall is flat.
    noise = spread[enough] / (count[enough] - 1) / count[enough]
    return math.sqrt(max(float((mean[enough].square() - noise).mean()), 0.0))
