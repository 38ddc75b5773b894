"""What a corrector says of itself, as JSON in every exported file."""

import platform

import torch

from tofcorr.conditions import CONDITIONS
from tofcorr.correction.limits import Limits
from tofcorr.correction.state import CalibrationState
from tofcorr.error_terms.domain import Interval
from tofcorr.version import __version__


def corrector_metadata(state: CalibrationState, limits: Limits) -> dict[str, object]:
    """Return camera, model, validity range and versions, ready for JSON."""
    camera = state.camera
    return {
        "format": "tofcorr-corrector",
        "version": 1,
        "model": state.name,
        "terms": state.error_model.to_mapping()["terms"],
        "residual_network": None if state.residual is None else state.residual.options.to_mapping(),
        "symbols": state.model().error.symbols(),
        "coefficients": state.coefficients.tolist(),
        "needs_amplitude": state.model().error.needs_amplitude(),
        "sign": "error = measured - true; corrected = measured - error",
        "depth_kind": state.depth_kind,
        "camera": {
            "width": camera.width,
            "height": camera.height,
            "K": [list(row) for row in camera.matrix],
            "distortion": list(camera.distortion),
        },
        "validity": {
            "radial_distance_m": list(limits.radial_distance),
            "amplitude": _finite(limits.amplitude),
            "normalised_amplitude": _finite(limits.normalised_amplitude),
            "saturation_amplitude": state.saturation_amplitude,
            "conditions": {name: list(known) for name, known in state.domain.conditions.items()},
        },
        "conditions_assumed": dict(zip(CONDITIONS, state.domain.mean_conditions(), strict=True)),
        "tool_from_camera": state.tool_from_camera.tolist(),
        "versions": {
            "tofcorr": __version__,
            "torch": str(torch.__version__),
            "python": platform.python_version(),
        },
    }


def _finite(interval: Interval) -> list[float] | None:
    """Return the interval, or None for one without ends."""
    return list(interval) if all(abs(end) < float("inf") for end in interval) else None
