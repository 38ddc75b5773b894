"""The numbers of a corrector in C: tables, polynomials, pieces and network."""

from dataclasses import dataclass

import numpy as np
import torch

from tofcorr.correction.export.c_code.pieces import Pieces, pieces_of
from tofcorr.correction.limits import Limits
from tofcorr.correction.runtime_error import RuntimeErrorModel, summed_polynomials
from tofcorr.correction.separable import separated
from tofcorr.correction.state import CalibrationState
from tofcorr.error_terms.residual import ResidualNetwork
from tofcorr.geometry.rays import ray_directions


@dataclass(frozen=True, kw_only=True)
class Content:
    """What the source holds.

    Attributes:
        width: Columns.
        height: Rows.
        limits: The calibrated ranges.
        polynomials: Of each variable, by its name: the error model's own, in float32.
        pieces: The other signal terms.
        row_error: Constant and pixel terms that depend on the row, shape (H,), metres.
        column_error: Those that depend on the column, shape (W,), metres.
        error_image: What rows and columns do not explain, shape (H, W); None if nothing.
        z_of_radial: The optical axis' share of each unit ray, shape (H, W); None for radial depth.
        network: The residual network; None if there is none.
        needs_amplitude: Whether the error depends on the amplitude.
    """

    width: int
    height: int
    limits: Limits
    polynomials: RuntimeErrorModel
    pieces: list[Pieces]
    row_error: np.ndarray
    column_error: np.ndarray
    error_image: np.ndarray | None
    z_of_radial: np.ndarray | None
    network: ResidualNetwork | None
    needs_amplitude: bool


@torch.no_grad()
def content_of(state: CalibrationState) -> Content:
    """Return the numbers of a calibration, for frames of the mean conditions.

    Raises:
        ConfigError: A term cannot be held.
    """
    model = state.model().error
    limits = Limits.of(state, model)
    runtime = RuntimeErrorModel(model, limits, 1.0)
    left_over = sum(
        one.left_over for one in (runtime.distance, runtime.amplitude, runtime.normalised)
    )
    rows, columns, rest = separated(model.pixel_error() + left_over)
    _, others = summed_polynomials(model)
    return Content(
        width=state.camera.width,
        height=state.camera.height,
        limits=limits,
        polynomials=runtime,
        pieces=[pieces_of(term, limits) for term in others],
        row_error=rows[:, 0].numpy(),
        column_error=columns[0].numpy(),
        error_image=None if rest is None else rest.numpy(),
        z_of_radial=ray_directions(state.camera)[..., 2].numpy()
        if state.depth_kind == "z"
        else None,
        network=model.residual,
        needs_amplitude=model.needs_amplitude(),
    )
