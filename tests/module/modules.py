"""Small modules of every kind of term, with random parameters, and frames for them."""

from dataclasses import replace
from typing import Any

import kinds_of_terms
import torch
from kinds_of_terms import DOMAIN
from small_recordings import CAMERA
from synthetic_scene import frame_batch
from torch import Tensor

from tofcorr.data.recording import FrameBatch
from tofcorr.module.depth_correction import DepthCorrection
from tofcorr.options import resolve_options
from tofcorr.training.calibration import TrainingOptions


def options_of(*kinds: str) -> TrainingOptions:
    """Return options with some kinds of terms; `residual_network` is one, too."""
    terms = [{"kind": kind} for kind in kinds if kind != "residual_network"]
    values: dict[str, Any] = {"name": kinds[0], "model": {"terms": terms}}
    if "residual_network" in kinds:
        values["residual"] = {"network": {"width": 3}}
    return resolve_options(TrainingOptions, values)


def module_of(*kinds: str, **arguments: Any) -> DepthCorrection:
    """Build a module of some kinds of terms, its parameters of the order of centimetres."""
    arguments = {"ranges": DOMAIN} | arguments
    module = DepthCorrection(CAMERA, options_of(*kinds), **arguments)
    randomise(module)
    return module


def randomise(module: DepthCorrection, size: float = 0.02) -> None:
    """Give every parameter, and the map of the pixels, random values."""
    kinds_of_terms.randomise(module, torch.Generator().manual_seed(3), size, 0.5)


def frames(
    leading: tuple[int, ...] = (2,), dtype: torch.dtype = torch.float64
) -> tuple[Tensor, Tensor]:
    """Draw frames inside the calibrated ranges of `DOMAIN`."""
    generator = torch.Generator().manual_seed(5)
    u = torch.rand(2, *leading, 5, 7, generator=generator, dtype=torch.float64)
    depth, amplitude = 0.8 + 1.4 * u[0], 100.0 + 60.0 * u[1]
    return depth.to(dtype), amplitude.to(dtype)


def conditions(leading: tuple[int, ...] = ()) -> dict[str, Any]:
    """Return conditions inside the calibrated ranges of `DOMAIN`, one a frame."""
    generator = torch.Generator().manual_seed(7)
    value = 2.2 + torch.rand(leading, generator=generator, dtype=torch.float64)
    own = {"timestamp_s": value, "room_temperature_c": value}
    return own | {"integration_time_us": 1e6 * value, "ambient": value}


def with_missing(depth: Tensor) -> Tensor:
    """Return frames with every kind of missing return."""
    depth = depth.clone()
    depth[..., 0, :5] = torch.tensor([torch.nan, 0.0, -1.0, torch.inf, -torch.inf])
    return depth


def wall_batch(module: DepthCorrection) -> FrameBatch:
    """Return frames of random planes; some pixels hold no measurement."""
    depth, amplitude = frames((3,))
    valid = torch.ones_like(depth, dtype=torch.bool)
    valid[..., 0, :5] = False
    tilt = 0.2 * torch.randn(3, 3, generator=torch.Generator().manual_seed(9)).double()
    normal = torch.nn.functional.normalize(tilt - torch.eye(3, dtype=torch.float64)[2], dim=-1)
    offset = torch.tensor([1.0, 2.0, 1.5], dtype=torch.float64)
    batch = frame_batch(with_missing(depth), amplitude, normal, offset, valid)
    return replace(batch, conditions=module.ranges.mean_conditions.expand(3, -1) + 0.1)
