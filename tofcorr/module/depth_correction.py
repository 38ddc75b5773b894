"""The correction as an `nn.Module`: error terms, residual network and hand-eye as parameters."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor

from tofcorr.correction.hand_eye import HandEye
from tofcorr.correction.hand_eye_accuracy import HandEyeAccuracy
from tofcorr.correction.state import DepthKind
from tofcorr.data.frames import FrameBatch
from tofcorr.error_terms.base import decode, encode
from tofcorr.error_terms.domain import Domain
from tofcorr.error_terms.model import ErrorModelOptions
from tofcorr.estimation.solvers import Watcher
from tofcorr.geometry.camera import CameraIntrinsics, FrameNames
from tofcorr.module import loading, saving
from tofcorr.module.configuration import (
    Terms,
    open_dataset,
    resolve_domain,
    resolve_terms,
)
from tofcorr.module.described_state import Labels
from tofcorr.module.frame_correction import FrameCorrection
from tofcorr.module.geometry import CameraGeometry
from tofcorr.module.ranges import CalibratedRanges
from tofcorr.module.report import FitReport
from tofcorr.options import resolve_options
from tofcorr.pixels.dataset import Recordings
from tofcorr.training.options import TrainingOptions


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
        super().__init__()
        self.options: TrainingOptions = resolve_terms(terms)
        self.camera = camera
        self.depth_kind: DepthKind = depth_kind or "radial"
        self.saturation_amplitude = saturation_amplitude
        self.hand_eye_estimated = True
        self.terms: ErrorModelOptions = self.options.model
        self.domain: Domain = resolve_domain(ranges, camera)
        self.covariance: Tensor | None = None
        self.noise: tuple[float, float, float] | None = None
        self.frames = FrameNames()
        self.hand_eye_accuracy: HandEyeAccuracy | None = None
        self.error_model = saving.untrained(self.terms, self.options, self.domain)
        self.hand_eye = HandEye()
        self.geometry = CameraGeometry(camera, self.depth_kind)
        self.ranges = CalibratedRanges()
        self.ranges.set(self.domain, saturation_amplitude, self.error_model)
        self.to(dtype)

    def batches(
        self,
        recordings: Recordings,
        frames: Sequence[int] | np.ndarray | None = None,
        frames_per_batch: int = 8,
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

        One pass over the pixels sums moments; L-BFGS minimises the point-to-plane loss computed
        from them. Ranges, depth kind and saturation amplitude become those of the recordings. The
        parameters are changed in place: optimisers that refer to them stay valid.

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
        from tofcorr.module.fitting import fit_to

        dataset = open_dataset(recordings, self.camera)
        first = dataset.first
        options = resolve_options(TrainingOptions, self.options, changes)
        fitted = fit_to(dataset, options, watcher, force=force)
        saving.copy_error_model(self, fitted.model.error, fitted.domain)
        saving.take_over(self, fitted)
        labels = self.labels()._replace(terms=fitted.terms, domain=fitted.domain)
        labels = labels._replace(
            depth_kind=first.depth_kind, saturation_amplitude=first.saturation_amplitude
        )
        saving.set_labels(self, labels)
        return fitted.report

    def save(self, file: Path | str) -> None:
        """Write the module to a file, whole or not at all; `load` reads it.

        Raises:
            ExportError: The file cannot be written.
        """
        saving.save(self, file)

    @classmethod
    def load(cls, path: Path | str) -> Self:
        """Read a module from a file that `save` wrote, or from the run folder of a training.

        Raises:
            CalibrationDataError: There is no such file or run, or it is not one of these.
        """
        return loading.load(cls, Path(path))

    def export(self, name: str, file: Path | str) -> None:
        """Write the module in a format of deployment, once it agrees with the float64 model.

        Args:
            name: A registered format, such as `torchscript`, `onnx` or `lut`.
            file: Where; an older file is replaced.

        Raises:
            ConfigError: There is no such format, or it cannot hold the model.
            ExportError: The export differs from the model, or cannot be written.
        """
        saving.export_as(self, name, file)

    def labels(self) -> Labels:
        """Return what the module says of itself besides its numbers."""
        own = (self.options, self.terms, self.camera, self.depth_kind, self.domain)
        return Labels(*own, self.saturation_amplitude, self.hand_eye_estimated)

    def description(self) -> dict[str, Any]:
        """Return what a state must agree on to be loaded."""
        return {"dtype": str(self.error_model.constant.dtype), **self.error_model.description()}

    def get_extra_state(self) -> Tensor:
        """Return description and labels as JSON in a tensor of bytes."""
        return encode({"description": self.description(), "labels": self.labels().to_mapping()})

    def set_extra_state(self, state: Tensor) -> None:
        """Take over the labels of a state; refuse that of another model."""
        super().set_extra_state(state)
        saving.set_labels(self, Labels.from_mapping(decode(state)["labels"], "the state"))

    def _description_in(self, state: Tensor) -> dict[str, Any]:
        """Return the description that stands beside the labels."""
        return decode(state)["description"]

    def load_state_dict(
        self, state_dict: Mapping[str, Any], strict: bool = True, assign: bool = False
    ) -> Any:  # noqa: ANN401 - torch's own named tuple
        """Load a state, with its ranges and camera; refuse that of another model untouched.

        Raises:
            StateError: The state is of other terms, another image size or another dtype.
        """
        loaded = super().load_state_dict(state_dict, strict=strict, assign=assign)
        self.covariance = self.noise = self.hand_eye_accuracy = None
        return loaded

    def extra_repr(self) -> str:
        """Return the model's name, image size, depth kind and range, for printing."""
        low, high = self.domain.radial_distance
        return (
            f"{self.options.name}, {self.camera.height}x{self.camera.width} pixels, "
            f"{self.depth_kind} depth, {low:.2f} to {high:.2f} m"
        )
