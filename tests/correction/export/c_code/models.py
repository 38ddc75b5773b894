"""Calibrations of every kind of term, and frames with everything that a camera may send."""

import math
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
from tofcorr.error_terms.registry import TERMS
from tofcorr.error_terms.residual import ResidualNetwork, ResidualNetworkOptions

_NO_AMPLITUDE = replace(DOMAIN, amplitude=None, normalised_amplitude=None)


def network(domain: Any = DOMAIN) -> ResidualState:
    """Return a residual network whose last layer is not zero."""
    options = ResidualNetworkOptions(width=6)
    weights = ResidualNetwork(options, domain).weight_vector()
    generator = torch.Generator().manual_seed(4)
    moved = weights + 0.3 * torch.randn(weights.shape, generator=generator).double()
    return ResidualState(options=options, weights=moved)


_DISTANCE, _AMPLITUDE = [{"kind": "distance_polynomial"}], [{"kind": "amplitude_polynomial"}]
_LOG = {"kind": "amplitude_polynomial", "variable": "log_amplitude", "degree": 5}
_NORMALISED = {"kind": "amplitude_polynomial", "variable": "normalised_amplitude"}

STATES: dict[str, dict[str, Any]] = {
    **{kind: {"terms": [{"kind": kind}]} for kind in TERMS},
    "a constant": {"terms": []},
    "log amplitude": {"terms": [_LOG]},
    "normalised amplitude": {"terms": [*_DISTANCE, _NORMALISED]},
    "saturation": {"terms": _DISTANCE, "saturation_amplitude": 500.0},
    "saturation in range": {"terms": _AMPLITUDE, "saturation_amplitude": 700.0},
    "network": {"terms": _DISTANCE, "residual": network()},
    "network of distance": {
        "terms": _DISTANCE, "domain": _NO_AMPLITUDE, "residual": network(_NO_AMPLITUDE)
    },
}  # fmt: skip
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
    state = calibration(depth_kind=depth_kind, **STATES[name])
    write("c", state, folder / "camera.c")
    return state, folder / "camera.c"
