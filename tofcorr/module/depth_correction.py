"""The correction as an `nn.Module`: error terms, residual network and hand-eye as parameters."""

# Long: one class, whose public methods have the docstrings of the API page.
import copy
import math
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, NoReturn, Self

import torch
from pydantic import AfterValidator, BeforeValidator, InstanceOf, TypeAdapter
from torch import Tensor

from tofcorr.correction.corrector import DepthCorrector
from tofcorr.correction.export import export
from tofcorr.correction.model import (
    CalibrationModel,
    CameraGeometry,
    FrameCorrection,
    HandEye,
    required_amplitude,
)
from tofcorr.correction.state import (
    STATE_FILE,
    CalibrationExtras,
    CalibrationState,
    Setting,
    load_calibration,
    read_values,
    save_values,
)
from tofcorr.data.recording import FrameBatch
from tofcorr.error_terms.base import Domain, Interval, decode, encode
from tofcorr.error_terms.model import ErrorModel, ErrorModelOptions
from tofcorr.error_terms.registry import TermOptions
from tofcorr.error_terms.residual import ResidualNetwork
from tofcorr.errors import CalibrationDataError, ConfigError, ExportError, StateError
from tofcorr.estimation.solvers import Watcher
from tofcorr.files import refuse_damaged
from tofcorr.geometry.camera import CameraIntrinsics, DepthKind
from tofcorr.options import one_line, resolve_options
from tofcorr.pixels.dataset import Dataset, Frames, Recordings, opened
from tofcorr.pixels.lattice import covered_domain
from tofcorr.training.calibration import Calibration, TrainingOptions
from tofcorr.training.judgement import report_text
from tofcorr.training.report import training_report
from tofcorr.training.run import Config, calibration_of, calibration_state, inspected

FORMAT = "tofcorr-module"

Terms = Config | ErrorModelOptions | Sequence[TermOptions | Mapping[str, Any]]
"""A shipped configuration's name or file, whole options, or the list of terms."""

# Ranges that scale the variables of a module until a fit or the user gives others. Metres and
# camera units; what today's time-of-flight cameras commonly measure indoors. Set by hand.
_USUAL = Domain(
    height=1,
    width=1,
    radial_distance=Interval(0.3, 5.0),
    amplitude=Interval(1.0, 1000.0),
    normalised_amplitude=Interval(1.0, 1000.0),
    # Lowest, highest and mean: an hour, 0.1 to 2 ms, two temperatures, some background light.
    conditions={
        "timestamp": (0.0, 3600.0, 1800.0),
        "integration_time": (1e-4, 2e-3, 1e-3),
        "room_temperature": (15.0, 30.0, 22.0),
        "body_temperature": (20.0, 60.0, 40.0),
        "ambient": (0.0, 1.0, 0.5),
    },
)


class Labels(Setting):
    """What a module says of itself besides the numbers that its output depends on.

    Attributes:
        options: How it is fitted.
        terms: Its terms, with what a fit found in the data.
    """

    options: TrainingOptions
    terms: ErrorModelOptions


def _numbers(values: Tensor) -> Tensor:
    if bool(values.isnan().any()):
        raise ValueError("holds what is not a number")
    return values


class _ModuleFile(CalibrationExtras):
    """What a file of `DepthCorrection.save` holds besides format and version."""

    state: dict[str, Annotated[InstanceOf[Tensor], AfterValidator(_numbers)]]


# report.json has null where there is no number.
_Millimetres = Annotated[float, BeforeValidator(lambda one: math.nan if one is None else one)]


@dataclass(frozen=True, kw_only=True)
class ErrorMM:
    """Distances of points to their planes, millimetres; NaN without frames.

    Attributes:
        mean_abs: Mean absolute distance.
        rms: Root mean square distance.
    """

    mean_abs: _Millimetres
    rms: _Millimetres


@dataclass(frozen=True, kw_only=True, repr=False)
class FitReport:
    """What `DepthCorrection.fit` found; printing it gives the summary.

    Attributes:
        model: The model's name.
        before: Error of held-out frames as recorded, with the recorded hand-eye transform.
        hand_eye_only: The same with the best hand-eye transform and no depth correction.
        after: The same with hand-eye transform and depth correction.
        held_out: Whether the errors are of held-out frames; if not, of the frames fitted.
        tool_from_camera: The hand-eye transform, 4 rows of 4, metres.
        translation_se_mm: Its standard errors along the tool's axes, millimetres.
        rotation_se_deg: Its standard errors about the tool's axes, degrees.
        stopped: Why the solver stopped; only "converged" is convergence.
        iterations: How many iterations it took.
        train_frames: Numbers of the frames fitted.
        test_frames: Numbers of the frames held out.
        warnings: What to know before the result is trusted, one sentence each.
        text: All of it as lines, with a verdict.
    """

    model: str
    before: ErrorMM
    hand_eye_only: ErrorMM
    after: ErrorMM
    held_out: bool
    tool_from_camera: tuple[tuple[float, ...], ...]
    translation_se_mm: tuple[float, ...]
    rotation_se_deg: tuple[float, ...]
    stopped: str
    iterations: int
    train_frames: tuple[int, ...]
    test_frames: tuple[int, ...]
    warnings: tuple[str, ...]
    text: str

    def __repr__(self) -> str:
        """Return what `tofcorr train` prints."""
        return self.text

    @classmethod
    def of(cls, told: Mapping[str, Any]) -> "FitReport":
        """Return the summary of what a training says of itself, the content of report.json."""
        half = "test" if told["frames"]["test"] else "train"
        values = {
            **told,
            **told["hand_eye"],
            **{stage: halves[half] for stage, halves in told["error_mm"].items()},
            "held_out": half == "test",
            "train_frames": told["frames"]["train"],
            "test_frames": told["frames"]["test"],
            "warnings": [*filter(None, [told["headline"]]), *told["warnings"]],
            "text": report_text(told),
        }
        return TypeAdapter(FitReport).validate_python(values)


class DepthCorrection(FrameCorrection):
    r"""Corrects depth frames, and learns to from frames of flat targets.

    .. math:: D_\mathrm{corrected} = D - E(D, I, r, c, \text{conditions})

    with the error E along the ray, metres; positive means that the camera reads too far (Abdo and
    Borgeat 2010). Every variable is clamped to its calibrated range before E is computed; where
    that changes it, the pixel is corrected but not `valid`. A pixel without a return (NaN,
    infinite, zero or negative depth, or an amplitude of NaN that the model needs) gives NaN. Its
    gradient is zero, and it contributes nothing to that of the parameters.

    Frames may be of any floating-point type (float16 resolves 1 mm only below 2 m) and have any
    leading dimensions; the result has their dtype. The module computes in that of its parameters,
    and writes no tensor in place. To deploy without autograd, `export` writes a `DepthCorrector`.

    Args:
        camera: Image size, pinhole matrix and distortion.
        terms: A shipped configuration's name such as "e0", "ea" or "eb", a YAML file, whole
            options, or the list of terms.
        ranges: The calibrated ranges, or recordings that cover them; they scale the variables and
            bound what is valid. None: usual ranges. `fit` replaces them by those of its recording.
        depth_kind: `radial` or `z`; None: radial. `fit` replaces it by that of its recording.
        saturation_amplitude: A pixel at or above it is not valid; None if unknown.
        dtype: Of parameters and buffers.

    Attributes:
        error_model: The terms and the residual network.
        hand_eye: tool_from_camera, as a twist around a starting transform.
        camera: The lateral parameters; `geometry` holds them, and the rays, as buffers.
        options: How `fit` fits: terms, residual network, solver, weights, split.
        terms: The terms, with what a fit found in the data where `options` says `auto`.
        hand_eye_estimated: False if `hand_eye` was known beforehand, as of a camera without robot.
        domain: The calibrated ranges; `ranges` holds what the output depends on as buffers.

    Raises:
        ConfigError: `terms` names no configuration, or an option is not allowed.
        CalibrationDataError: `ranges` lacks what a term needs, such as the modulation frequency.

    Shape:
        - Input: `(..., H, W)`, depth in metres and amplitude in the camera's units.
        - Output: `(..., H, W)`, corrected depth in metres, of the kind and dtype of the input.

    Example:
        >>> import torch, tofcorr
        >>> K = ((90.0, 0.0, 3.5), (0.0, 90.0, 2.5), (0.0, 0.0, 1.0))
        >>> camera = tofcorr.CameraIntrinsics(width=8, height=6, matrix=K)
        >>> module = tofcorr.DepthCorrection(camera, terms="e0")
        >>> depth = torch.ones(2, 6, 8, requires_grad=True)
        >>> module(depth).sum().backward()
        >>> bool((depth.grad == 1.0).all())
        True
    """

    def __init__(
        self,
        camera: CameraIntrinsics,
        terms: Terms = "ea",
        *,
        ranges: Domain | Recordings | None = None,
        depth_kind: DepthKind | None = None,
        saturation_amplitude: float | None = None,
        dtype: torch.dtype = torch.float64,
    ) -> None:
        options, domain = resolve_terms(terms), resolve_domain(ranges, camera)
        depth_kind, error = depth_kind or "radial", _untrained(options, domain)
        super().__init__(camera, depth_kind, error, HandEye(), domain, saturation_amplitude)
        self.options: TrainingOptions = options
        self.terms: ErrorModelOptions = options.model
        self.camera = camera
        self.depth_kind: DepthKind = depth_kind
        self.domain: Domain = domain
        self.saturation_amplitude = saturation_amplitude
        self.hand_eye_estimated = True
        self.extras = CalibrationExtras()
        self.to(dtype)

    def crop(self, top: int, left: int, height: int, width: int) -> Self:
        """Return the module for a part of the image: it corrects a crop as this one does the whole.

        It shares all parameters with this module, so that random crops train them. Call this one's
        `save`, `fit` and `export`.

        Args:
            top: First row.
            left: First column.
            height: Number of rows.
            width: Number of columns.

        Raises:
            FrameError: The part is not inside the image.
        """
        return self._part(top, left, height, width)

    def resize(self, height: int, width: int) -> Self:
        """Return the module for the image resized, its outer edges kept.

        Each new pixel has the error of the place where its centre lies; a fixed pattern is averaged
        over it. All parameters are shared, as with `crop`. After `fit` resize anew.

        Args:
            height: Number of rows.
            width: Number of columns.
        """
        return self._part(0, 0, self.camera.height, self.camera.width, (height, width))

    def bin(self, number: int) -> Self:
        """Return the module for the means of squares of `number` x `number` pixels, see `resize`.

        What the last rows and columns lack of a square is cut off.
        """
        height, width = self.camera.height // number, self.camera.width // number
        return self._part(0, 0, number * height, number * width, (height, width))

    def _part(
        self, top: int, left: int, height: int, width: int, size: tuple[int, int] | None = None
    ) -> Self:
        part, window = copy.copy(self), (top, left, height, width)
        part._modules = dict(self._modules)
        part.camera = self.camera.crop(*window)
        part.geometry = self.geometry.cropped(top, left, part.camera)
        if size is not None:
            part.camera = part.camera.resize(*size)
            part.geometry = CameraGeometry(part.camera, self.depth_kind).to(self.geometry.matrix)
        size = part.camera.height, part.camera.width
        part.domain = replace(self.domain, height=size[0], width=size[1])
        part.error_model = self.error_model.part(*window, size)
        return part

    def batches(
        self, recordings: Recordings, frames: Frames | None = None, frames_per_batch: int = 8
    ) -> Iterator[FrameBatch]:
        """Yield the frames of recordings in batches for `point_to_plane_loss`, read from disk.

        Args:
            recordings: Of this module's camera.
            frames: Their numbers, through all recordings; None: all.
            frames_per_batch: Most frames in a batch.
        """
        dataset = open_dataset(recordings, self.camera)
        pixels = self.camera.height * self.camera.width
        device = str(self.error_model.constant.device)
        yield from dataset.batches(frames, device, frames_per_batch * pixels)

    def fit(
        self,
        recordings: Recordings,
        changes: Sequence[str] = (),
        watcher: Watcher | None = None,
        force: bool = False,
    ) -> FitReport:
        """Fit terms, residual network and hand-eye transform, as `tofcorr train` does.

        One pass over the pixels sums moments; Gauss-Newton steps minimise the point-to-plane loss
        computed from them. Ranges, depth kind and saturation amplitude become those of the
        recordings. The parameters are changed in place: optimisers that refer to them stay valid.

        Args:
            recordings: Of this module's camera.
            changes: Options to change for this fit, such as `"split.test_fraction=0"`.
            watcher: Called after each iteration; returning False interrupts the solver.
            force: Fit whatever `tofcorr.inspect` finds.

        Returns:
            Held-out errors, hand-eye transform with standard errors, and warnings.

        Raises:
            CalibrationDataError: The recordings are of another camera, or cannot support the model.
            ConfigError: A change is not allowed.
        """
        self._refuse_crop()
        dataset = open_dataset(recordings, self.camera)
        options = resolve_options(TrainingOptions, self.options, changes)
        data, options, inspection, left_out = inspected(dataset, options, force=force)
        fitted = partial(Calibration, watcher=watcher, left_out=left_out)
        found = calibration_of(data, options, fitted)
        told = training_report(found, options.model_copy(update={"advice": 0}), inspection)
        self._take_over(calibration_state(found.data, options, found.fit))
        return FitReport.of(told)

    def point_to_plane_loss(self, batch: FrameBatch) -> Tensor:
        """Return the mean squared distance of corrected points to their planes, square metres.

        The loss that `fit` minimises, for training loops of one's own: differentiable in all
        parameters, the hand-eye transform included. `batches` yields the batches of a recording.

        Args:
            batch: Frames with the planes that they show; pixels that are not valid do not count.

        Raises:
            FrameError: The model needs amplitudes and the batch has none.
        """
        error, like = self.error_model, self.error_model.constant
        usable = batch.valid.to(like.device)
        # What is not measured may be NaN, which a factor of zero would not remove from the
        # gradient.
        distance = torch.where(usable, batch.radial_distance.to(like), 1.0)
        strength = distance
        if error.needs_amplitude():
            strength = torch.where(usable, required_amplitude(batch.amplitude).to(like), 1.0)
        conditions = None
        if batch.conditions is not None and len(error.condition_terms):
            conditions = batch.conditions.to(like)
            conditions = torch.where(conditions.isnan(), self.ranges.mean_conditions, conditions)
        plane = batch.normal_tool.to(like), batch.offset_tool.to(like)
        residual = CalibrationModel(error, self.hand_eye).residual(
            distance, strength, self.geometry.ray_directions, *plane, conditions
        )
        return torch.where(usable, residual, 0.0).square().sum() / usable.sum().clamp(min=1)

    def save(self, file: Path | str) -> None:
        """Write the module to a file, whole or not at all; `load` reads it.

        Raises:
            ExportError: The file cannot be written.
        """
        self._refuse_crop()
        values = {"state": self.state_dict(), **self.extras.model_dump()}
        save_values(file, FORMAT, values, ExportError)

    @classmethod
    def load(cls, path: Path | str) -> Self:
        """Read a module from a file that `save` wrote, or from the run folder of a training.

        The module corrects every pixel alone. What else a run removes of a frame (stray light,
        second bounces, flying pixels) `tofcorr.load_corrector` and exports of the module do.

        Raises:
            CalibrationDataError: There is no such file or run, or it is not one of these.
        """
        path = Path(path)
        if path.is_dir():
            return cls._from_run(path)
        refuse_damaged(path, "a calibration or a module that tofcorr wrote")
        with zipfile.ZipFile(path) as archive:
            if any("/code/" in name for name in archive.namelist()):
                raise CalibrationDataError(
                    f"{path}: holds nothing to fit: use tofcorr.load_corrector."
                )
        values = read_values(path, FORMAT)
        if values is None:
            return cls._from_calibration(load_calibration(path), None)
        return cls._from_values(values, path)

    def export(self, name: str, file: Path | str) -> None:
        """Write the module in a format of deployment, once it agrees with the float64 model.

        Args:
            name: A registered format, such as `torchscript`, `onnx` or `lut`.
            file: Where; an older file is replaced.

        Raises:
            ConfigError: There is no such format, or it cannot hold the model.
            ExportError: The export differs from the model, or cannot be written.
        """
        state = self.to_state()
        export(name, DepthCorrector.from_state(state), file, state)

    def __prepare_scriptable__(self) -> NoReturn:
        """Refuse `torch.jit.script`, which cannot compile terms that are chosen at run time."""
        said = "torch.jit.script cannot compile a DepthCorrection"
        raise ExportError(f"{said}: write module.export('torchscript', 'corrector.ts').")

    def to_state(self) -> CalibrationState:
        """Return the module as a calibration, which exporters read.

        Raises:
            ConfigError: It is another module, cropped or resized.
        """
        self._refuse_crop()
        return CalibrationState.of(
            self.error_model,
            name=self.options.name,
            error_model=self.terms,
            tool_from_camera=self.hand_eye().double(),
            **dict(Setting.model_validate(self, from_attributes=True)),
            **dict(self.extras),
        )

    def _refuse_crop(self) -> None:
        if self.error_model.is_part:
            advice = "fit, save and export the module that it was made from"
            raise ConfigError(
                f"this module is a crop or resized, and shares its parameters: {advice}."
            )

    def labels(self) -> Labels:
        """Return what the module says of itself besides its numbers."""
        return Labels.model_validate(self, from_attributes=True)

    def description(self) -> dict[str, Any]:
        """Return what a state must agree on to be loaded."""
        return self.error_model.description()

    def get_extra_state(self) -> Tensor:
        """Return description and labels as JSON in a tensor of bytes."""
        return encode({"description": self.description(), "labels": self.labels().to_mapping()})

    def set_extra_state(self, state: Tensor) -> None:
        """Take over the labels of a state; refuse that of another model."""
        super().set_extra_state(state)
        self.extras = CalibrationExtras(frames=self.extras.frames)
        self._set_labels(Labels.from_mapping(decode(state)["labels"], "the state"))

    def _description_in(self, state: Tensor) -> dict[str, Any]:
        """Return the description that stands beside the labels."""
        return {k: v for k, v in decode(state)["description"].items() if k != "dtype"}

    def extra_repr(self) -> str:
        """Return the model's name, image size, depth kind and range, for printing."""
        low, high = self.domain.radial_distance
        size = f"{self.camera.height}x{self.camera.width} pixels"
        return f"{self.options.name}, {size}, {self.depth_kind} depth, {low:.2f} to {high:.2f} m"

    def _set_labels(self, labels: Labels) -> None:
        """Set what the module says of itself, and the buffers that follow from it."""
        for name in Labels.model_fields:
            setattr(self, name, getattr(labels, name))
        self.error_model.set_options(labels.terms)
        self.geometry.set_depth_kind(labels.depth_kind)
        self.ranges.set(labels.domain, labels.saturation_amplitude, self.error_model)

    def _take_over(self, state: CalibrationState) -> None:
        """Become a calibration of the same terms: parameters keep their identity.

        A hand-eye transform that was not estimated takes no part in training either. Otherwise it
        is trained or frozen as it was.
        """
        self._copy_error_model(state.model().error, state.domain)
        self.hand_eye.rebase(state.tool_from_camera)
        if state.hand_eye_estimated != self.hand_eye_estimated:
            self.hand_eye.twist.requires_grad_(state.hand_eye_estimated)
        self.extras = state.extras()
        named = {name: getattr(state, name) for name in Labels.model_fields if hasattr(state, name)}
        self._set_labels(self.labels().model_copy(update={**named, "terms": state.error_model}))

    def _copy_error_model(self, error: ErrorModel, domain: Domain) -> None:
        """Copy parameters and buffers of an error model of the same terms, scaled to `domain`.

        A residual network that the model lacks (a fit drops one that does not help) becomes
        untrained and adds nothing. One that reads other inputs replaces the module's own.
        """
        own, residual = self.error_model, self.options.residual
        network = error.residual
        if network is None and residual is not None:
            network = ResidualNetwork(residual.network, domain)
        others = "residual.", "_extra_state"
        terms = {k: v for k, v in error.state_dict().items() if not k.startswith(others)}
        own.load_state_dict(terms, strict=False)
        if network is not None and own.residual is not None:
            if network.description() == own.residual.description():
                own.residual.load_state_dict(network.state_dict())
            else:
                own.residual = copy.deepcopy(network).to(own.constant)

    @classmethod
    def _from_values(cls, values: Mapping[str, Any], path: Path) -> Self:
        """Build a module from the content of a file that `save` wrote."""
        try:
            entry = _ModuleFile.from_mapping(values, str(path))
            state = entry.state
            labels = Labels.from_mapping(decode(state["_extra_state"])["labels"], str(path))
            # The terms found are those of the options: what was `auto` may differ in size.
            terms = labels.options.model_copy(update={"model": labels.terms})
            module = cls(labels.camera, terms, ranges=labels.domain)
            module.to(state["error_model.constant"].dtype).load_state_dict(state)
            module.hand_eye.twist.requires_grad_(labels.hand_eye_estimated)
            module.extras = entry.extras()
            module.to_state()  # Refuses other numbers than the terms have.
        except (ConfigError, StateError) as error:
            raise CalibrationDataError(f"{path}: {str(error).removeprefix(f'{path}: ')}") from None
        except (LookupError, ValueError, TypeError, RuntimeError) as error:
            # For example a tensor of another shape than the module's, in load_state_dict.
            why = one_line(" ".join(str(error).split()))
            raise CalibrationDataError(f"{path}: is damaged ({why}).") from None
        return module

    @classmethod
    def _from_run(cls, folder: Path) -> Self:
        config = folder / "config.yaml"
        options = resolve_options(TrainingOptions, config) if config.is_file() else None
        state = load_calibration(folder / STATE_FILE)
        if options is not None and not state.error_model.same_coefficients(options.model):
            said = f"has other terms than {STATE_FILE} beside it. Copy it again, or remove it"
            raise CalibrationDataError(f"{config}: {said}: defaults then hold.")
        return cls._from_calibration(state, options)

    @classmethod
    def _from_calibration(cls, state: CalibrationState, options: TrainingOptions | None) -> Self:
        """Build a module of a calibration; without options, with those that it says."""
        if options is None:
            residual = None if state.residual is None else {"network": state.residual.options}
            given = {"name": state.name, "model": state.error_model, "residual": residual}
            options = TrainingOptions.model_validate(given)
        terms = options.model_copy(update={"model": state.error_model})
        module = cls(state.camera, terms, ranges=state.domain)
        module.options = options
        module._take_over(state)
        return module


def _untrained(options: TrainingOptions, domain: Domain) -> ErrorModel:
    """Build the error model, with the residual network if the options ask for one.

    Raises:
        CalibrationDataError: The domain lacks what a term needs.
    """
    try:
        error = ErrorModel(options.model, domain)
    except CalibrationDataError as missing:
        advice = "For a DepthCorrection, pass ranges=recording, or a Domain with the missing entry."
        raise CalibrationDataError(f"{missing} {advice}") from None
    if options.residual is not None:
        error.residual = ResidualNetwork(options.residual.network, domain)
    return error


def resolve_terms(terms: Terms) -> TrainingOptions:
    """Return whole options, with the defaults of a training where only terms are given.

    Raises:
        ConfigError: There is no such configuration, or a value is not allowed.
    """
    if isinstance(terms, Sequence) and not isinstance(terms, str):
        given = [dict(term) if isinstance(term, Mapping) else term.to_mapping() for term in terms]
        terms = ErrorModelOptions.from_mapping({"terms": given}, "terms")
    if isinstance(terms, ErrorModelOptions):
        name = " + ".join(term.kind for term in terms.terms) or "constant"
        return TrainingOptions(name=name, model=terms)
    return resolve_options(TrainingOptions, terms)


def resolve_domain(ranges: Domain | Recordings | None, camera: CameraIntrinsics) -> Domain:
    """Return the ranges given, those of all frames of recordings, or the usual ones.

    Raises:
        CalibrationDataError: The recordings are of another camera, or hold no usable pixel.
        ConfigError: `camera` is something else, such as the recording.
    """
    if not isinstance(camera, CameraIntrinsics):
        got = f"expected a tofcorr.CameraIntrinsics, got {type(camera).__name__}"
        raise ConfigError(f"camera: {got}. A recording holds its own, as recording.camera.")
    if ranges is None or isinstance(ranges, Domain):
        return replace(ranges or _USUAL, height=camera.height, width=camera.width)
    dataset = open_dataset(ranges, camera)
    return covered_domain(dataset, range(dataset.num_frames))


def open_dataset(recordings: Recordings, camera: CameraIntrinsics) -> Dataset:
    """Open one or several recordings of a camera.

    Raises:
        CalibrationDataError: A recording is broken, or its image size, K or distortion differ.
    """
    dataset = Dataset(opened(recordings))
    found = dataset.first.camera
    if found != camera:
        said = f"is of the camera {found}, the module was built for {camera}"
        raise CalibrationDataError(f"{dataset.first.path}: {said}: build one of recording.camera.")
    return dataset
