"""A module from files: its own, and the calibrations of runs."""

import zipfile
from pathlib import Path
from typing import TYPE_CHECKING, Literal, TypeVar

import torch
from pydantic import InstanceOf
from torch import Tensor

from tofcorr.correction.state import STATE_FILE, UNREADABLE, CalibrationState, load_calibration
from tofcorr.correction.state_file import ExtraEntry
from tofcorr.error_terms.base import decode
from tofcorr.errors import CalibrationDataError, ConfigError, StateError
from tofcorr.files.seal import refuse_damaged
from tofcorr.fit.core import same_terms
from tofcorr.module.described_state import Labels
from tofcorr.module.saving import FORMAT, VERSION, copy_error_model, set_labels, take_over
from tofcorr.options import load_options
from tofcorr.options.messages import one_line
from tofcorr.training.options import TrainingOptions

if TYPE_CHECKING:
    from tofcorr.module.depth_correction import DepthCorrection

ModuleT = TypeVar("ModuleT", bound="DepthCorrection")


def load(cls: type[ModuleT], path: Path) -> ModuleT:
    """Read a module from a file that `save` wrote, or from a run folder or its `state.pt`.

    Raises:
        CalibrationDataError: There is no such file, or it is not one of these.
    """
    if path.is_dir():
        return _from_run(cls, path)
    if not path.is_file():
        raise CalibrationDataError(f"{path}: there is no such file or run folder.")
    refuse_damaged(path, "a calibration or a module that tofcorr wrote")
    if _is_scripted(path):
        raise CalibrationDataError(
            f"{path}: is a corrector in TorchScript, which holds no parameters to fit: use it by "
            "torch.jit.load, or load the run folder that it was written in."
        )
    try:
        values = torch.load(path, map_location="cpu", weights_only=True)
    except UNREADABLE:
        values = None
    if isinstance(values, dict) and str(values.get("format")) == FORMAT:
        version = one_line(str(values.get("version")))
        if version != str(VERSION):
            raise CalibrationDataError(
                f"{path}: has version {version}, this package reads {VERSION}."
            )
        return _from_file(cls, values, path)
    return _from_calibration(cls, load_calibration(path), None)


def _is_scripted(path: Path) -> bool:
    """Return whether an archive of torch holds code."""
    with zipfile.ZipFile(path) as archive:
        return any("/code/" in name for name in archive.namelist())


class _ModuleFile(ExtraEntry):
    """What a file of `save` holds."""

    format: Literal["tofcorr-module"]
    version: Literal[1]
    state: dict[str, InstanceOf[Tensor]]


def _from_file(cls: type[ModuleT], values: dict, path: Path) -> ModuleT:
    try:
        entry = _ModuleFile.from_mapping(values, str(path))
        labels = Labels.from_mapping(decode(entry.state["_extra_state"])["labels"], str(path))
        module = _build(cls, labels).to(entry.state["error_model.constant"].dtype)
        _refuse_other_numbers(entry.state)
        module.load_state_dict(entry.state)
        module.hand_eye.twist.requires_grad_(labels.hand_eye_estimated)
    except (ConfigError, StateError) as error:
        raise CalibrationDataError(f"{path}: {str(error).removeprefix(f'{path}: ')}") from None
    except (LookupError, ValueError, TypeError, RuntimeError) as error:
        # For example a tensor of another shape than the module's, in load_state_dict.
        why = one_line(" ".join(str(error).split()))
        raise CalibrationDataError(f"{path}: is damaged ({why}).") from None
    module.covariance, module.noise = entry.covariance, entry.noise
    module.frames, accuracy = entry.frames, entry.hand_eye_accuracy
    module.hand_eye_accuracy = None if accuracy is None else accuracy.accuracy()
    return module


def _refuse_other_numbers(state: dict[str, Tensor]) -> None:
    """Refuse values that no parameter and no buffer can have."""
    for name, values in state.items():
        if values.is_floating_point() and bool(values.isnan().any()):
            raise ValueError(f"'{name}' holds what is not a number")


def _from_run(cls: type[ModuleT], folder: Path) -> ModuleT:
    config = folder / "config.yaml"
    options = load_options(TrainingOptions, config) if config.is_file() else None
    state = load_calibration(folder / STATE_FILE)
    if options is not None and not same_terms(state.error_model, options.model):
        raise CalibrationDataError(
            f"{config}: its model has other terms than {STATE_FILE} beside it; it was changed, or "
            "its copy was cut short. Copy it again; or remove it: fits then use defaults."
        )
    return _from_calibration(cls, state, options)


def _from_calibration(
    cls: type[ModuleT], state: CalibrationState, options: TrainingOptions | None
) -> ModuleT:
    """Build a module from a calibration; without options, with those that the calibration says."""
    if options is None:
        residual = None if state.residual is None else {"network": state.residual.options}
        options = TrainingOptions(
            name=state.name,
            model=state.error_model,
            residual=residual,  # type: ignore[arg-type]
        )
    labels = Labels(
        options,
        state.error_model,
        state.camera,
        state.depth_kind,
        state.domain,
        state.saturation_amplitude,
    )
    module = _build(cls, labels)
    model = state.model()
    copy_error_model(module, model.error, state.domain)
    take_over(module, state)
    return module


def _build(cls: type[ModuleT], labels: Labels) -> ModuleT:
    # The terms found are known to be those of the options: what was `auto` may differ in size.
    module = cls(
        labels.camera,
        labels.options.model_copy(update={"model": labels.terms}),
        ranges=labels.domain,
        depth_kind=labels.depth_kind,
        saturation_amplitude=labels.saturation_amplitude,
    )
    set_labels(module, labels)
    return module
