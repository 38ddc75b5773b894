"""Calibrations of every kind of term, and frames with everything that a camera may send."""

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from correction.export.states import calibration, write
from kinds_of_terms import DOMAIN
from torch import Tensor

from tofcorr.correction.state import CalibrationState, ResidualState
from tofcorr.error_terms.base import EVERYTHING
from tofcorr.error_terms.model import ErrorModel, ErrorModelOptions
from tofcorr.error_terms.registry import TERMS
from tofcorr.error_terms.residual import ResidualNetwork, ResidualNetworkOptions

_NO_AMPLITUDE = replace(DOMAIN, amplitude=None, normalised_amplitude=None)


def state_of(terms: list[dict[str, Any]], depth_kind: str, **changed: Any) -> CalibrationState:
    """Return a calibration whose coefficients are random, about 20 mm."""
    options = ErrorModelOptions.from_mapping({"terms": terms}, "test")
    size = ErrorModel(options, DOMAIN).coefficient_vector().shape
    generator = torch.Generator().manual_seed(3)
    values: dict[str, Any] = {
        "error_model": options,
        "domain": DOMAIN,
        "depth_kind": depth_kind,
        "coefficients": 0.02 * torch.randn(size, generator=generator).double(),
        "fixed_pattern": 0.02 * torch.randn(5, 7, generator=generator).double(),
    }
    return calibration(np.eye(4), **(values | changed))


def network(domain: Any = DOMAIN) -> ResidualState:
    """Return a residual network whose last layer is not zero."""
    options = ResidualNetworkOptions(width=6)
    weights = ResidualNetwork(options, domain).weight_vector()
    generator = torch.Generator().manual_seed(4)
    moved = weights + 0.3 * torch.randn(weights.shape, generator=generator).double()
    return ResidualState(options=options, weights=moved)


_DISTANCE = [{"kind": "distance_polynomial"}]
_LOG = {"kind": "amplitude_polynomial", "variable": "log_amplitude", "degree": 5}
_NORMALISED = {"kind": "amplitude_polynomial", "variable": "normalised_amplitude"}

STATES: dict[str, Callable[[str], CalibrationState]] = {
    **{kind: lambda depth, kind=kind: state_of([{"kind": kind}], depth) for kind in TERMS},
    "a constant": lambda depth: state_of([], depth),
    "log amplitude": lambda depth: state_of([_LOG], depth),
    "normalised amplitude": lambda depth: state_of([*_DISTANCE, _NORMALISED], depth),
    "saturation": lambda depth: state_of(_DISTANCE, depth, saturation_amplitude=500.0),
    "saturation in range": lambda depth: state_of(
        [{"kind": "amplitude_polynomial"}], depth, saturation_amplitude=700.0
    ),
    "network": lambda depth: state_of(_DISTANCE, depth, residual=network()),
    "network of distance": lambda depth: state_of(
        _DISTANCE, depth, domain=_NO_AMPLITUDE, residual=network(_NO_AMPLITUDE)
    ),
}
"""Every kind of term, every variable, both kinds of saturation and of network."""


def hard_frames(state: CalibrationState, number: int, seed: int) -> tuple[Tensor, Tensor]:
    """Return frames (number, H, W) in and around the ranges, a third of it special values."""
    generator = torch.Generator().manual_seed(seed)
    shape = (number, state.camera.height, state.camera.width)
    limits = state.model().error.limits(state.domain)
    special = (math.nan, math.inf, -math.inf, 0.0, -0.0, -1.0, 1e-45, 3e38)
    frames = []
    for low, high in (limits.radial_distance, limits.amplitude or EVERYTHING):
        low, high = max(low, 1.0), min(high, 1e4)  # noqa: PLW2901 - some have no end
        values = 0.8 * low + (1.3 * high - 0.8 * low) * torch.rand(shape, generator=generator)
        ends = [value for end in (low, high) for value in _neighbours(end)]
        pool = torch.tensor([*special, *ends], dtype=torch.float32)
        chosen = pool[torch.randint(len(pool), shape, generator=generator)]
        frames.append(torch.where(torch.rand(shape, generator=generator) < 1 / 3, chosen, values))
    return frames[0], frames[1]


def _neighbours(value: float) -> tuple[float, float, float]:
    """Return a float32 number between its neighbours."""
    middle = np.float32(value)
    below, above = (np.nextafter(middle, np.float32(end)) for end in (-np.inf, np.inf))
    return float(below), float(middle), float(above)


def exported(name: str, depth_kind: str, folder: Path) -> tuple[CalibrationState, Path]:
    """Return a calibration and the C file that it was exported to."""
    state = STATES[name](depth_kind)
    write("c", state, folder / "camera.c")
    return state, folder / "camera.c"
