"""A sample of pixels with their errors before and after, for figures."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from tofcorr.correction.model import CalibrationModel
from tofcorr.data.frames import FrameBatch
from tofcorr.errors import CalibrationDataError
from tofcorr.pixels.dataset import Dataset
from tofcorr.pixels.plane_distance import cosine_of_incidence, distance_to_plane

# About how many pixels figures are drawn from: enough for narrow bins, few enough to cost a
# fraction of a second. Set by hand.
_SAMPLE_PIXELS = 300_000
# About how many pixels are read to draw them from: bounds the time on long recordings. Set by hand.
_READ_PIXELS = 4_000_000


@dataclass(frozen=True)
class PixelSample:
    """Usable pixels, drawn at random.

    Attributes:
        frame: Global number of each pixel's frame, shape (M,).
        covariates: What errors are drawn against, by axis label, each (M,).
        errors_mm: Measured minus true distance along the ray at each stage, each (M,).
    """

    frame: np.ndarray
    covariates: dict[str, np.ndarray]
    errors_mm: dict[str, np.ndarray]

    def covariate_named(self, name: str) -> str:
        """Return the axis label of a covariate from its name without unit.

        Raises:
            CalibrationDataError: There is no such covariate.
        """
        labels = {label.split(" [")[0]: label for label in self.covariates}
        if name not in labels:
            raise CalibrationDataError(
                f"There is no covariate '{name}' to draw errors against; this recording has: "
                f"{', '.join(labels)}."
            )
        return labels[name]


def sample_pixels(
    dataset: Dataset, stages: Mapping[str, CalibrationModel], frames: Sequence[int] | np.ndarray
) -> PixelSample:
    """Draw pixels at random from some frames, and compute their errors.

    The same call always draws the same pixels.

    Args:
        dataset: The recordings.
        stages: The models whose errors are wanted; the last one's hand-eye defines incidence.
        frames: Global numbers of the frames; of long recordings only some frames, evenly spread,
            are read.
    """
    camera = dataset.first.camera
    size = camera.height * camera.width
    read = thinned(np.asarray(frames), max(_READ_PIXELS // size, 1))
    step = max(size * len(read) // _SAMPLE_PIXELS, 1)
    return _join([_sample(dataset, stages, batch, step) for batch in dataset.batches(read)])


def thinned(values: np.ndarray, most: int) -> np.ndarray:
    """Return at most `most` of the values, evenly spread over their order."""
    if len(values) <= most:
        return values
    return values[np.linspace(0, len(values) - 1, most).round().astype(int)]


def errors_along_ray(
    dataset: Dataset, model: CalibrationModel, batch: FrameBatch
) -> tuple[Float[Tensor, "B H W"], Float[Tensor, "B H W"]]:
    """Return measured minus true distance in mm (B, H, W), NaN where not valid, and cosines."""
    rays = dataset.ray_directions().to(batch.radial_distance)
    residual = distance_to_plane(model, batch, rays)
    cosine = cosine_of_incidence(model, batch, rays)
    return torch.where(batch.valid, 1e3 * residual / cosine, torch.nan), cosine


def _sample(
    dataset: Dataset, stages: Mapping[str, CalibrationModel], batch: FrameBatch, step: int
) -> PixelSample:
    valid = batch.valid.reshape(-1).nonzero()[:, 0]
    # At random: a regular step would meet the same columns in every row.
    chosen = valid[torch.randperm(len(valid), generator=_generator())[: len(valid) // step + 1]]
    height, width = batch.valid.shape[1:]
    pixel = chosen % (height * width)
    errors, cosine = {}, None
    for name, model in stages.items():
        error, cosine = errors_along_ray(dataset, model, batch)
        errors[name] = error.reshape(-1)[chosen].numpy()
    covariates = {
        "distance [m]": batch.radial_distance.reshape(-1)[chosen],
        "row [pixel]": pixel // width,
        "column [pixel]": pixel % width,
    }
    if batch.amplitude is not None:
        covariates["amplitude [camera's units]"] = batch.amplitude.reshape(-1)[chosen]
    if cosine is not None:
        angle = torch.rad2deg(torch.acos(cosine.reshape(-1)[chosen].abs().clamp(max=1.0)))
        covariates["angle of incidence [degrees]"] = angle
    return PixelSample(
        frame=batch.indices[chosen // (height * width)].numpy(),
        covariates={name: values.numpy().astype(np.float64) for name, values in covariates.items()},
        errors_mm=errors,
    )


def _join(parts: Iterable[PixelSample]) -> PixelSample:
    parts = list(parts)
    first = parts[0]
    return PixelSample(
        frame=np.concatenate([part.frame for part in parts]),
        covariates={k: np.concatenate([p.covariates[k] for p in parts]) for k in first.covariates},
        errors_mm={k: np.concatenate([p.errors_mm[k] for p in parts]) for k in first.errors_mm},
    )


def _generator() -> torch.Generator:
    """Return the generator that picks the pixels drawn: figures do not change from run to run."""
    return torch.Generator().manual_seed(0)
