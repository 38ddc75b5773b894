"""What a live calibration keeps of a frame, in memory and on disk, and on which ranges."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from pydantic import TypeAdapter
from torch import Tensor

from tofcorr.conditions import CONDITIONS
from tofcorr.data.table import FrameRow
from tofcorr.error_terms.base import Domain, Interval
from tofcorr.error_terms.model import ErrorModelOptions, columns_on
from tofcorr.errors import CalibrationDataError, ConfigError
from tofcorr.estimation.moments import ImageMoments
from tofcorr.estimation.robust import robust_scale
from tofcorr.pixels.lattice import Lattice
from tofcorr.training.calibration import TrainingOptions

FRAME_FORM = "tofcorr-live-frame"


@dataclass(frozen=True)
class Sums:
    """What is kept of the pixels of a frame.

    Attributes:
        domain: The ranges that scale the columns of its moments.
        moments: Of its pixels; their plane is nobody's.
        lattice: Some of its pixels.
        images: The images (1, H, W) by name, where what a corrector finds in whole images is
            looked for; else none.
    """

    domain: Domain
    moments: ImageMoments
    lattice: Lattice
    images: Mapping[str, np.ndarray] = field(default_factory=dict)

    def on(self, domain: Domain, terms: ErrorModelOptions) -> "Sums":
        """Return the same on other ranges, for some terms."""
        if domain == self.domain:
            return self
        gram = mapped(self.moments.gram, columns_on(terms, domain, self.domain))
        return replace(self, domain=domain, moments=replace(self.moments, gram=gram))

    def thinned(self, most: int) -> "Sums":
        """Return the same with so many pixels at most."""
        return replace(self, lattice=self.lattice.thinned(most))


@dataclass(frozen=True)
class KeptFrame:
    """What is known of a frame besides its sums.

    Attributes:
        row: Its row of `frames.csv`.
        noise: Typical standard deviation of a distance, metres, from neighbours; 1 if unknown.
        distance: Median over its pixels, metres.
        brightness: Median amplitude; NaN without any.
        seen: The share of usable pixels of each of nine parts of the image, row by row.
    """

    row: FrameRow
    noise: float
    distance: float
    brightness: float
    seen: tuple[float, ...]

    @classmethod
    def of(cls, row: FrameRow, domain: Domain, lattice: Lattice) -> "KeptFrame":
        """Return what the pixels of a frame show."""
        between = lattice.difference[lattice.difference.isfinite()]
        place, distance = lattice.place, lattice.radial_distance[0]
        part = 3 * (3 * place // (domain.width * domain.height))
        part = part + 3 * (place % domain.width) // domain.width
        usable = part.bincount(distance.isfinite().double(), 9) / part.bincount(minlength=9)
        noise = robust_scale(between) if len(between) else 1.0
        medians = float(distance.nanmedian()), float(lattice.amplitude.nanmedian())
        return cls(row, noise, *medians, tuple(usable.tolist()))


def seen_from(
    world_from_tool: np.ndarray, row: FrameRow, tool_from_camera: np.ndarray
) -> tuple[float, float, float]:
    """Return how a pose (4, 4) sees the wall of a frame.

    Returns:
        Distance along the optical axis, metres; tilt of that axis against the wall's normal,
        degrees; roll about it from the frame's pose, degrees.
    """
    camera, before = world_from_tool @ tool_from_camera, row.world_from_tool @ tool_from_camera
    facing = float(row.normal_world @ camera[:3, 2])
    distance = -float(row.normal_world @ camera[:3, 3] + row.offset) / facing
    turn = before[:3, :3].T @ camera[:3, :3]
    roll = math.degrees(math.atan2(turn[1, 0] - turn[0, 1], turn[0, 0] + turn[1, 1]))
    return distance, math.degrees(math.acos(min(1.0, abs(facing)))), roll


def coverage(frames: list[KeptFrame], tool_from_camera: np.ndarray) -> dict[str, list[float]]:
    """Return what frames cover, by what it is of.

    Returns:
        Of each frame `distance` (m), `tilt` (degrees) and `brightness` (the amplitude), medians
        over it; `image`: the share of usable pixels of each of nine parts, row by row.
    """
    axes = np.array([one.row.world_from_tool[:3] for one in frames]) @ tool_from_camera[:, 2]
    facing = (axes * [one.row.normal_world for one in frames]).sum(axis=1)
    return {
        "distance": [one.distance for one in frames],
        "tilt": np.degrees(np.arccos(np.abs(facing).clip(max=1))).tolist(),
        "brightness": [one.brightness for one in frames if math.isfinite(one.brightness)],
        "image": np.mean([one.seen for one in frames], axis=0).tolist(),
    }


def suitable(options: TrainingOptions, domain: Domain) -> TrainingOptions:
    """Return the options, if they need the pixels of no two frames at once.

    Args:
        options: Of the fit.
        domain: Any ranges.

    Raises:
        ConfigError: The message names it.
    """
    asked = {
        "weights.robust": options.weights.robust != "none",
        "weights.noise": options.weights.noise,
        "residual": options.residual is not None,
        "outlier_window_mm": options.outlier_window_mm is not None,
        "a fixed pattern": any(not term.has_columns for term in options.model.terms),
    }
    for name in [name for name, given in asked.items() if given]:
        raise ConfigError(f"{name} looks at all frames at once; train on the recording for it.")
    try:
        columns_on(of_images(options.model), domain, wider(domain))
    except CalibrationDataError as error:
        raise ConfigError(str(error)) from None
    return options


def is_of_frames(term: Any) -> bool:  # noqa: ANN401 - options of any term
    """Whether a term is a function of a frame's conditions, which no sum over pixels holds."""
    return any(name in CONDITIONS for name in term.needs)


def of_images(options: ErrorModelOptions) -> ErrorModelOptions:
    """Return the terms that have columns of pixels."""
    terms = tuple(term for term in options.terms if not is_of_frames(term))
    return ErrorModelOptions(terms=terms)


def wider(domain: Domain) -> Domain:
    """Return ranges wider by a quarter to both sides, so that the next frame hardly leaves them."""

    def grown(one: Interval | None) -> Interval | None:
        margin = 0.0 if one is None else (one.high - one.low) / 4
        return one and Interval(one.low - min(margin, one.low / 2), one.high + margin)

    names = "radial_distance", "amplitude", "normalised_amplitude"
    return replace(domain, **{name: grown(getattr(domain, name)) for name in names})


def mapped(gram: Tensor, functions: Tensor) -> Tensor:
    """Return moments (N, S, S) of other functions, given as combinations of theirs (C, C)."""
    columns = torch.block_diag(torch.eye(1).double(), functions)
    entries = torch.block_diag(torch.kron(columns, torch.eye(3).double()), torch.eye(1).double())
    return entries @ gram @ entries.T


_DOMAIN = TypeAdapter(Domain)


def values_of_frame(row: FrameRow, sums: Sums) -> dict[str, Any]:
    """Return a frame as plain values and tensors."""
    cells = {
        name: torch.from_numpy(value) if isinstance(value, np.ndarray) else value
        for name, value in vars(row).items()
        if value is not None
    }
    pixels = {"moments": vars(sums.moments), "lattice": vars(sums.lattice)}
    pixels["images"] = {name: torch.from_numpy(image) for name, image in sums.images.items()}
    return {"row": cells, "domain": _DOMAIN.dump_python(sums.domain, mode="json"), **pixels}


def frame_of(values: dict[str, Any]) -> tuple[FrameRow, Sums]:
    """Return the frame that `values_of_frame` wrote."""
    row = {k: v.numpy() if isinstance(v, Tensor) else v for k, v in values["row"].items()}
    pixels = ImageMoments(**values["moments"]), Lattice(**values["lattice"])
    images = {name: image.numpy() for name, image in values.get("images", {}).items()}
    return FrameRow(**row), Sums(_DOMAIN.validate_python(values["domain"]), *pixels, images)
