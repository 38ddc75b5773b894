"""The ranges of distance, amplitude and conditions that a set of pixels covers."""

from collections.abc import Sequence
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from tofcorr.conditions import CONDITIONS
from tofcorr.data.arrays import read_frames
from tofcorr.data.recording import Recording, valid_pixels
from tofcorr.error_terms.domain import Domain, Interval
from tofcorr.errors import CalibrationDataError
from tofcorr.geometry.camera import CameraIntrinsics
from tofcorr.geometry.rays import ray_directions
from tofcorr.pixels.dataset import Dataset
from tofcorr.pixels.threads import in_threads


def covered_domain(
    dataset: Dataset,
    frames: Sequence[int] | np.ndarray,
    outside_share: float = 0.001,
    pixels: int = 200_000,
) -> Domain:
    """Return image size, and the central 99.8 % of distances and amplitudes of usable pixels.

    A regular sample of pixels is looked at, the same number in every frame.

    Args:
        dataset: The recordings.
        frames: Global numbers of the frames.
        outside_share: Share of the values left out at either end of a range: a few stray pixels
            must not widen the range in which a correction is valid.
        pixels: About how many the ranges are determined from, at least 50 a frame.

    Raises:
        CalibrationDataError: No pixel of these frames is usable.
    """
    per_frame = max(pixels // max(len(frames), 1), 50)
    samples = (
        [
            _sample(recording, local, per_frame)
            for recording, _, local in dataset.by_recording(frames)
        ]
        if dataset.exclude is None
        else _sample_not_excluded(dataset, frames, per_frame)
    )
    distance = torch.cat([sample[0] for sample in samples])
    if not distance.numel():
        raise CalibrationDataError(
            f"{dataset.first.path}: no pixel of the {len(frames)} frames asked for is usable; "
            "check mask.npy, saturation_amplitude and the unit of depth.npy (metres)."
        )
    amplitude = None
    if dataset.has_amplitude:
        amplitude = torch.cat([sample[1] for sample in samples if sample[1] is not None])
    return domain_from(
        dataset.first.camera,
        distance,
        amplitude,
        dataset.first.modulation_frequency,
        dataset.conditions(frames),
        outside_share=outside_share,
    )


def domain_from(
    camera: CameraIntrinsics,
    radial_distance: Float[Tensor, "M"],
    amplitude: Float[Tensor, "M"] | None,
    modulation_frequency: float | None,
    conditions: Float[Tensor, "N C"],
    *,
    outside_share: float,
    method: Literal["linear", "nearest"] = "linear",
) -> Domain:
    """Return the ranges that some pixels cover.

    Args:
        camera: Gives the image size.
        radial_distance: Of the pixels, shape (M,), metres.
        amplitude: Of the same pixels, shape (M,); None if not recorded.
        modulation_frequency: Of the light, Hz; None if unknown.
        conditions: Of the frames, in the order of `CONDITIONS`, shape (N, C); NaN: unknown.
        outside_share: Share of the values that may lie below a range, and above it.
        method: How to interpolate between the two values nearest to a quantile.
    """
    normalised = None if amplitude is None else amplitude * radial_distance * radial_distance

    def interval(values: torch.Tensor) -> Interval:
        quantiles = (outside_share, 1 - outside_share)
        low, high = np.quantile(values.numpy(), quantiles, method=method)
        return Interval(float(low), float(high))

    return Domain(
        height=camera.height,
        width=camera.width,
        radial_distance=interval(radial_distance),
        amplitude=None if amplitude is None else interval(amplitude),
        normalised_amplitude=None if normalised is None else interval(normalised),
        modulation_frequency=modulation_frequency,
        conditions=_known_conditions(conditions),
    )


def _known_conditions(values: Float[Tensor, "N C"]) -> dict[str, tuple[float, float, float]]:
    """Return lowest, highest and mean value of each condition that is known of all frames."""
    return {
        name: (float(column.min()), float(column.max()), float(column.mean()))
        for name, column in zip(CONDITIONS, values.unbind(1), strict=True)
        if bool(column.isfinite().all())
    }


def _sample_not_excluded(
    dataset: Dataset, frames: Sequence[int] | np.ndarray, per_frame: int
) -> list[tuple[torch.Tensor, torch.Tensor | None]]:
    """Return distances and amplitudes of a regular sample; reads all pixels, as exclusion must."""
    camera = dataset.first.camera
    step = max(camera.height * camera.width // per_frame, 1)
    samples = []
    for batch in dataset.batches(frames):
        amplitude = None if batch.amplitude is None else batch.amplitude[batch.valid][::step]
        samples.append((batch.radial_distance[batch.valid][::step], amplitude))
    return samples


def _sample(
    recording: Recording, frames: np.ndarray, per_frame: int
) -> tuple[torch.Tensor, torch.Tensor | None]:
    """Return distances and amplitudes of a regular sample of the usable pixels."""
    size = recording.camera.height * recording.camera.width
    # A step that shares no factor with the width visits all columns.
    step = max(size // per_frame, 1)
    while step > 1 and np.gcd(step, recording.camera.width) > 1:
        step -= 1
    z_of_ray = ray_directions(recording.camera)[..., 2].reshape(-1)[::step]

    def of_frame(frame: int) -> tuple[torch.Tensor, torch.Tensor | None]:
        depth, amplitude, mask = (
            None
            if array is None
            else torch.from_numpy(read_frames(array, np.array([frame])).reshape(-1)[::step])
            for array in (recording.depth, recording.amplitude, recording.mask)
        )
        assert depth is not None  # Every recording has it.
        valid = valid_pixels(depth, amplitude, mask, recording.saturation_amplitude)
        radial = depth.double() / z_of_ray if recording.depth_kind == "z" else depth.double()
        return radial[valid], None if amplitude is None else amplitude.double()[valid]

    distances, amplitudes = zip(*in_threads(of_frame, frames.tolist()), strict=True)
    known = [amplitude for amplitude in amplitudes if amplitude is not None]
    return torch.cat(distances), torch.cat(known) if known else None


def within(domain: Domain, distance: Tensor, amplitude: Tensor | None) -> Tensor:
    """Return where distance and amplitude lie within the ranges, of the shape of the distance."""
    low, high = domain.radial_distance
    inside = (distance >= low) & (distance <= high)
    if domain.amplitude is not None and amplitude is not None:
        low, high = domain.amplitude
        inside &= (amplitude >= low) & (amplitude <= high)
    return inside
