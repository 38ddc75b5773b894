"""Evenly spread pixels of every frame: all that a fit reads of pixels besides their sums.

They give the ranges that scale the model's variables, the noise of a distance, and what that noise
moves. Which pixels of a frame are taken depends on how many frames there are, and not on what they
show, so that a calibration that grows frame by frame sees what one of the finished recording sees.
"""

from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from tofcorr.conditions import CONDITIONS
from tofcorr.data.recording import FrameBatch
from tofcorr.error_terms.base import Domain, Interval
from tofcorr.error_terms.model import Pixels
from tofcorr.errors import CalibrationDataError
from tofcorr.estimation.noise import DistanceNoise, fit_noise, neighbour_differences
from tofcorr.estimation.robust import without_strays
from tofcorr.geometry.camera import CameraIntrinsics
from tofcorr.geometry.rays import Rays, plane_in_frame
from tofcorr.pixels.dataset import Dataset, Frames, in_threads
from tofcorr.pixels.sample import FramePixels

# Most pixels of a frame. Chosen: ten frames then have forty beyond each end of the ranges, which
# leave out a thousandth, and a frame takes 64 kB in place of the 2.5 MB of a VGA image.
_MOST = 4096
# Most pixels of all frames together. Chosen: a thousand are then beyond each end of the ranges, and
# they take 17 MB; up to 256 frames none is left out.
_MOST_OF_ALL = 2**20


@dataclass(frozen=True)
class Lattice:
    """Pixels of some frames, the same ones of each; P of N frames. NaN: not usable.

    Attributes:
        place: Numbers of the pixels, counted row by row, shape (P,).
        radial_distance: Shape (N, P), float32, metres.
        amplitude: The camera's units, shape (N, P), float32; NaN without any.
        difference: Of each pixel and its neighbours in the row, scaled to the variance of the
            difference of two distances, shape (N, P), float32, metres.
        brightness: Mean amplitude of those, shape (N, P), float32.
    """

    place: Int[Tensor, "P"]
    radial_distance: Float[Tensor, "N P"]
    amplitude: Float[Tensor, "N P"]
    difference: Float[Tensor, "N P"]
    brightness: Float[Tensor, "N P"]

    def frames(self, chosen: Frames) -> "Lattice":
        """Return the pixels of some of the frames, by their place among them."""
        pick = torch.as_tensor(np.asarray(chosen))
        return replace(self, **{name: getattr(self, name)[pick] for name in _IMAGES})

    def thinned(self, most: int) -> "Lattice":
        """Return so many pixels at most, which are among those of any larger number."""
        if most >= len(self.place):
            return self
        kept = scattered(self.place).argsort()[:most].sort().values
        images = {name: getattr(self, name)[:, kept] for name in _IMAGES}
        return Lattice(place=self.place[kept], **images)


NumbersT = TypeVar("NumbersT", Tensor, np.ndarray)


def scattered(numbers: NumbersT) -> NumbersT:
    """Return numbers from 0 to 2^32 that spread evenly, whichever successive integers are given."""
    # Multiples of the golden ratio, less their whole parts (Knuth).
    return numbers * 2654435769 % 2**32


_IMAGES = ("radial_distance", "amplitude", "difference", "brightness")


def joined(parts: list[Lattice]) -> Lattice:
    """Return the pixels of all frames of several lattices of one camera: those of the smallest."""
    least = min(len(one.place) for one in parts)
    parts = [one.thinned(least) for one in parts]
    images = {name: torch.cat([getattr(one, name) for one in parts]) for name in _IMAGES}
    return replace(parts[0], **images)


def most_pixels(frames: int) -> int:
    """Return how many pixels are kept of each of so many frames."""
    return _MOST_OF_ALL >> (max(frames, 1) - 1).bit_length()


def lattice_of(dataset: Dataset, frames: Frames | None = None) -> Lattice:
    """Return the lattice of frames, in increasing order: one pass over the images."""
    rays, batches = dataset.ray_directions(), dataset.batches(frames)
    most = most_pixels(dataset.num_frames if frames is None else len(frames))
    return joined([*in_threads(lambda one: lattice_in(one, rays).thinned(most), batches)])


def lattice_in(batch: FrameBatch, rays: Rays) -> Lattice:
    """Return the lattice of the frames of a batch, whose unit rays are (H, W, 3)."""
    height, width = rays.shape[:2]
    step = int(np.ceil((height * width / _MOST) ** 0.5))
    rows, columns = (torch.arange((size - 1) % step // 2, size, step) for size in (height, width))
    # A pixel and its neighbours; at the border it is its own, which tells nothing.
    beside = (columns[:, None] + torch.tensor([-1, 0, 1])).clamp(0, width - 1)
    inside = (beside.diff(dim=1) > 0).all(dim=1).repeat(len(rows))
    three = (rows[:, None, None] * width + beside).view(-1, 3)
    distance, valid = (image.flatten(1)[:, three] for image in (batch.radial_distance, batch.valid))
    distance = distance.double()
    amplitude = torch.full_like(distance, torch.nan)
    if batch.amplitude is not None:
        amplitude = batch.amplitude.flatten(1)[:, three].double()
    near = rays.flatten(0, 1)[three]
    between, mean = neighbour_differences(distance, amplitude, valid, near)
    return Lattice(
        place=three[:, 1].clone(),  # Without its neighbours.
        radial_distance=torch.where(valid, distance, torch.nan)[..., 1].float(),
        amplitude=amplitude[..., 1].float(),
        difference=torch.where(inside, between[..., 0], torch.nan).float(),
        brightness=mean[..., 0].float(),
    )


def covered_domain(dataset: Dataset, frames: Frames, lattice: Lattice | None = None) -> Domain:
    """Return image size, and the central 99.8 % of distances and amplitudes of usable pixels.

    Args:
        dataset: The recordings.
        frames: Global numbers of the frames.
        lattice: That of the frames; None: it is read.

    Raises:
        CalibrationDataError: No pixel of these frames is usable.
    """
    seen, first = lattice_of(dataset, frames) if lattice is None else lattice, dataset.first
    usable = seen.radial_distance.isfinite()
    distance, amplitude = (one[usable].double() for one in (seen.radial_distance, seen.amplitude))
    if not distance.numel():
        advice = "check mask.npy, saturation_amplitude and the unit of depth.npy (metres)"
        said = f"no pixel of the {len(frames)} frames asked for is usable; {advice}"
        raise CalibrationDataError(f"{first.path}: {said}.")
    light = amplitude if dataset.has_amplitude else None, first.modulation_frequency
    return domain_from(first.camera, distance, *light, dataset.conditions(frames))


def estimate_noise(
    dataset: Dataset, frames: Frames, lattice: Lattice | None = None
) -> DistanceNoise:
    """Return the noise of a measured distance as a function of its amplitude.

    It is estimated from repeats, frames that differ by noise alone. Without any, neighbouring
    pixels give an upper bound.

    Args:
        dataset: The recordings.
        frames: Global numbers of the frames.
        lattice: That of the frames; None: it is read.

    Raises:
        CalibrationDataError: There are no amplitudes, too few pixels, or most differences are zero.
    """
    dataset.require("amplitude", "the noise model")
    seen = lattice_of(dataset, frames) if lattice is None else lattice
    groups = dataset.repeat_groups()[np.asarray(frames)]
    pairs = [
        (own[k], own[k + 1])
        for own in (np.flatnonzero(groups == group) for group in np.unique(groups))
        for k in range(0, len(own) - 1, 2)
    ]
    if not pairs:
        return fit_noise(
            seen.difference.double().flatten(), seen.brightness.flatten(), "neighbours"
        )
    first, second = torch.from_numpy(np.array(pairs)).T
    change = seen.radial_distance[second].double() - seen.radial_distance[first].double()
    change -= change.nanmedian(dim=1, keepdim=True).values
    mean = (seen.amplitude[first] + seen.amplitude[second]) / 2
    return fit_noise(change.flatten(), mean.flatten(), "repeats")


def spread_pixels(dataset: Dataset, frames: Frames, lattice: Lattice, most: int) -> FramePixels:
    """Return the usable pixels of a lattice, or as many evenly spread ones of every frame.

    Args:
        dataset: The recordings.
        frames: Global numbers of the frames.
        lattice: That of the frames.
        most: How many are wanted, about.
    """
    step = max(1, lattice.radial_distance.numel() // most)
    distance, amplitude = (
        one[:, ::step].double() for one in (lattice.radial_distance, lattice.amplitude)
    )
    frame, at = distance.isfinite().nonzero(as_tuple=True)
    place, width = lattice.place[::step][at], dataset.first.camera.width
    normal, offset = plane_in_frame(*dataset.planes_and_poses(frames))
    pixels = Pixels(
        distance[frame, at],
        amplitude[frame, at],
        (place // width).double(),
        (place % width).double(),
        dataset.conditions(frames)[frame],
    )
    rays = dataset.ray_directions().flatten(0, 1)[place]
    return FramePixels(frame, pixels, rays, normal[frame], offset[frame])


def domain_from(
    camera: CameraIntrinsics,
    radial_distance: Float[Tensor, "M"],
    amplitude: Float[Tensor, "M"] | None,
    modulation_frequency: float | None,
    conditions: Float[Tensor, "N C"],
) -> Domain:
    """Return the ranges that some pixels cover, without 0.1 % of the values at either end.

    Args:
        camera: Gives the image size.
        radial_distance: Of the pixels, shape (M,), metres.
        amplitude: Of the same pixels, shape (M,); None if not recorded.
        modulation_frequency: Of the light, Hz; None if unknown.
        conditions: Of the frames, in the order of `CONDITIONS`, shape (N, C); NaN: unknown.
    """
    normalised = None if amplitude is None else amplitude * radial_distance.square()
    near_and_far, *others = (
        None if values is None else Interval(*without_strays(values.numpy()))
        for values in (radial_distance, amplitude, normalised)
    )
    assert near_and_far is not None
    return Domain(
        height=camera.height,
        width=camera.width,
        radial_distance=near_and_far,
        amplitude=others[0],
        normalised_amplitude=others[1],
        modulation_frequency=modulation_frequency,
        conditions=condition_ranges(conditions),
    )


def condition_ranges(conditions: Float[Tensor, "N C"]) -> dict[str, tuple[float, float, float]]:
    """Return least, largest and mean value of each condition that is known of all frames (N, C)."""
    return {
        name: (float(column.min()), float(column.max()), float(column.mean()))
        for name, column in zip(CONDITIONS, conditions.unbind(1), strict=True)
        if bool(column.isfinite().all())
    }
