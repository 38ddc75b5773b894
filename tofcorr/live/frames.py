"""What a live calibration keeps of a frame, in memory and on disk, and on which ranges."""

import math
from dataclasses import dataclass, replace
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
from tofcorr.geometry.camera import CameraIntrinsics
from tofcorr.pixels.lattice import Lattice
from tofcorr.training.calibration import TrainingOptions

FRAME_FORM = "tofcorr-live-frame"


@dataclass(frozen=True)
class KeptFrame:
    """What is kept of a frame.

    Attributes:
        row: What is known of it besides its images.
        domain: The ranges that scale the columns of its moments; when it comes, its own.
        moments: Of its pixels; their plane is nobody's.
        lattice: Some of its pixels.
        noise: Typical standard deviation of a distance, metres, from neighbours; 1 if unknown.
    """

    row: FrameRow
    domain: Domain
    moments: ImageMoments
    lattice: Lattice
    noise: float

    @classmethod
    def of(
        cls, row: FrameRow, domain: Domain, moments: ImageMoments, lattice: Lattice
    ) -> "KeptFrame":
        """Return what is kept, with the noise that the pixels show."""
        between = lattice.difference[lattice.difference.isfinite()]
        return cls(row, domain, moments, lattice, robust_scale(between) if len(between) else 1.0)

    def on(self, domain: Domain, change: Tensor) -> "KeptFrame":
        """Return it with other ranges, given the change of the columns (`columns_on`)."""
        moments = replace(self.moments, gram=mapped(self.moments.gram, change))
        return replace(self, domain=domain, moments=moments)


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


def coverage(
    frames: list[KeptFrame], camera: CameraIntrinsics, tool_from_camera: np.ndarray
) -> dict[str, list[float]]:
    """Return what frames cover, by what it is of.

    Returns:
        Of each frame `distance` (m), `tilt` (degrees) and `brightness` (the amplitude), medians
        over it; `image`: the share of usable pixels of each of nine parts, row by row.
    """
    light = [float(one.lattice.amplitude.nanmedian()) for one in frames]
    seen = torch.zeros(3, 3).double()
    for one in frames:
        place = one.lattice.place
        part = 3 * place // (camera.width * camera.height), 3 * (place % camera.width)
        part = part[0], part[1] // camera.width
        usable = one.lattice.radial_distance[0].isfinite().double()
        every = torch.zeros(3, 3).double().index_put(part, torch.ones(1).double(), accumulate=True)
        seen += torch.zeros(3, 3).double().index_put(part, usable, accumulate=True) / every
    return {
        "distance": [float(one.lattice.radial_distance.nanmedian()) for one in frames],
        "tilt": [seen_from(x.row.world_from_tool, x.row, tool_from_camera)[1] for x in frames],
        "brightness": [one for one in light if math.isfinite(one)],
        "image": (seen / max(1, len(frames))).flatten().tolist(),
    }


def suitable(options: TrainingOptions) -> TrainingOptions:
    """Refuse what needs the pixels of all frames at once.

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
    one = nominal_domain(4, 4)
    ranges = "radial_distance", "amplitude", "normalised_amplitude"
    other = replace(one, **dict.fromkeys(ranges, Interval(1.5, 3.0)))
    try:
        columns_on(of_images(options.model), one, other)
    except CalibrationDataError as error:
        raise ConfigError(str(error)) from None
    return options


def nominal_domain(height: int, width: int) -> Domain:
    """Return ranges for an image of which nothing is known yet."""
    one = Interval(1.0, 2.0)
    return Domain(
        height=height,
        width=width,
        radial_distance=one,
        amplitude=one,
        normalised_amplitude=one,
        modulation_frequency=1e7,
    )


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


def values_of_frame(frame: KeptFrame) -> dict[str, Any]:
    """Return a frame as plain values and tensors."""
    row = {
        name: torch.from_numpy(value) if isinstance(value, np.ndarray) else value
        for name, value in vars(frame.row).items()
        if value is not None
    }
    sums = {"moments": vars(frame.moments), "lattice": vars(frame.lattice)}
    return {"row": row, "domain": _DOMAIN.dump_python(frame.domain, mode="json"), **sums}


def frame_of(values: dict[str, Any]) -> KeptFrame:
    """Return the frame that `values_of_frame` wrote."""
    row = {k: v.numpy() if isinstance(v, Tensor) else v for k, v in values["row"].items()}
    moments, lattice = ImageMoments(**values["moments"]), Lattice(**values["lattice"])
    domain = _DOMAIN.validate_python(values["domain"])
    return KeptFrame.of(FrameRow(**row), domain, moments, lattice)
