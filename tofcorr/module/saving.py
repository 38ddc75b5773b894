"""A module's way to files, and from calibrations and fits."""

import copy
import io
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import torch

from tofcorr.correction.corrector import DepthCorrector
from tofcorr.correction.export import export
from tofcorr.correction.state import (
    CalibrationState,
    ResidualState,
)
from tofcorr.error_terms.domain import Domain
from tofcorr.error_terms.model import ErrorModel, ErrorModelOptions
from tofcorr.error_terms.residual import ResidualNetwork
from tofcorr.errors import CalibrationDataError
from tofcorr.files.seal import sealed
from tofcorr.files.staged import staged_file
from tofcorr.fit.problem import FitOptions
from tofcorr.module.described_state import Labels

if TYPE_CHECKING:
    from tofcorr.module.depth_correction import DepthCorrection
    from tofcorr.module.fitting import Fitted

ModuleT = TypeVar("ModuleT", bound="DepthCorrection")

FORMAT, VERSION = "tofcorr-module", 1


def untrained(terms: ErrorModelOptions, options: FitOptions, domain: Domain) -> ErrorModel:
    """Build the error model, with the residual network if the options ask for one.

    Raises:
        CalibrationDataError: The domain lacks what a term needs.
    """
    try:
        error = ErrorModel(terms, domain)
    except CalibrationDataError as missing:
        raise CalibrationDataError(
            f"{missing} For a DepthCorrection, pass ranges=recording, or ranges=Domain(...) with "
            "the missing entry."
        ) from None
    if options.residual is not None:
        error.residual = ResidualNetwork(options.residual.network, domain)
    return error


def copy_error_model(module: "DepthCorrection", error: ErrorModel, domain: Domain) -> None:
    """Copy parameters and buffers of an error model of the same terms.

    A residual network that the model lacks (a fit drops one that does not help) becomes untrained
    and adds nothing. One that reads other inputs replaces the module's own.

    Args:
        module: Its parameters keep their identity.
        error: The model to copy.
        domain: The ranges that the model is scaled to.
    """
    own, residual = module.error_model, module.options.residual
    network = error.residual
    if network is None and residual is not None:
        network = ResidualNetwork(residual.network, domain)
    own.load_state_dict(_of_terms(error.state_dict()), strict=False)
    if network is not None and own.residual is not None:
        if network.description() == own.residual.description():
            own.residual.load_state_dict(network.state_dict())
        else:
            own.residual = copy.deepcopy(network).to(own.constant)


def set_labels(module: "DepthCorrection", labels: Labels) -> None:
    """Set what a module says of itself, and the buffers that follow from it."""
    module.options, module.terms = labels.options, labels.terms
    module.camera, module.depth_kind = labels.camera, labels.depth_kind
    module.domain, module.saturation_amplitude = labels.domain, labels.saturation_amplitude
    module.hand_eye_estimated = labels.hand_eye_estimated
    module.error_model.set_options(labels.terms)
    module.geometry.set_depth_kind(labels.depth_kind)
    module.ranges.set(labels.domain, labels.saturation_amplitude, module.error_model)


def take_over(module: "DepthCorrection", found: "CalibrationState | Fitted") -> None:
    """Set the hand-eye transform, what is known of all errors, and what the frames are called.

    A hand-eye transform that was not estimated takes no part in training either. Otherwise it is
    trained or frozen as it was.
    """
    module.hand_eye.rebase(found.tool_from_camera)
    if found.hand_eye_estimated != module.hand_eye_estimated:
        module.hand_eye.twist.requires_grad_(found.hand_eye_estimated)
    module.hand_eye_estimated = found.hand_eye_estimated
    module.frames, module.hand_eye_accuracy = found.frames, found.hand_eye_accuracy
    module.covariance, module.noise = found.covariance, found.noise


def to_state(module: "DepthCorrection") -> CalibrationState:
    """Return the module as a calibration, which exporters read."""
    error = module.error_model
    pattern, network = error.fixed_pattern, error.residual
    residual = None
    # An untrained network adds nothing; not every format can hold a network.
    if network is not None and bool(network.last.weight.any() or network.last.bias.any()):
        weights = network.weight_vector().double().cpu()
        residual = ResidualState(options=network.options, weights=weights)
    return CalibrationState(
        name=module.options.name,
        error_model=module.terms,
        domain=module.domain,
        coefficients=error.coefficient_vector().double().cpu(),
        tool_from_camera=module.hand_eye().detach().double().cpu(),
        hand_eye_estimated=module.hand_eye_estimated,
        camera=module.camera,
        depth_kind=module.depth_kind,
        saturation_amplitude=module.saturation_amplitude,
        fixed_pattern=None if pattern is None else pattern.offset.detach().double().cpu(),
        residual=residual,
        covariance=module.covariance,
        noise=module.noise,
        frames=module.frames,
        hand_eye_accuracy=module.hand_eye_accuracy,
    )


def export_as(module: "DepthCorrection", name: str, file: Path | str) -> None:
    """Write a module in a format of deployment."""
    state = to_state(module)
    export(name, DepthCorrector.from_state(state), file, state)


def save(module: "DepthCorrection", file: Path | str) -> None:
    """Write a module to a file, whole or not at all."""
    accuracy = module.hand_eye_accuracy
    values = {
        "format": FORMAT,
        "version": VERSION,
        "state": module.state_dict(),
        "covariance": module.covariance,
        "noise": module.noise,
        "frames": module.frames.to_mapping(),
        "hand_eye_accuracy": None if accuracy is None else asdict(accuracy),
    }
    content = io.BytesIO()
    torch.save(values, content)
    with staged_file(file) as staged:
        staged.write_bytes(sealed(content))


def _of_terms(state: dict[str, Any]) -> dict[str, Any]:
    """Return the state of constant, terms and map, without the residual network."""
    return {
        key: value
        for key, value in state.items()
        if not key.startswith("residual.") and key != "_extra_state"
    }
