"""The options that `evaluate` and `select` share."""

from collections.abc import Iterable
from typing import Any, Self

from pydantic import Field, NonNegativeInt

from tofcorr.comparison.compared_models import ComparedModel
from tofcorr.data.recording import Recording
from tofcorr.estimation.solution import SolverOptions
from tofcorr.pixels.hand_eye import HandEyeOptions
from tofcorr.pixels.masks import MaskOptions
from tofcorr.pixels.plane_choice import PlaneChoice, resolved_planes
from tofcorr.plausibility.checks.garbage import FAR_OFF
from tofcorr.plausibility.inspection import Inspection
from tofcorr.training.left_out import against_garbage
from tofcorr.training.options import TrainingOptions


class ComparisonOptions(MaskOptions):
    """Models, what is common to them, and which held-out pixels measure them.

    The keys of the masks (`mask`, `outlier_window_mm`, ...) choose the pixels of the recording
    once, before any split, as its mask.npy does. Every model is measured on those pixels, whatever
    pixels it was fitted to. A model that sets a key of the masks is fitted to pixels of its own,
    found without the held-out images.

    Attributes:
        models: The models to compare.
        seed: Seed of every random choice of images.
        hand_eye: What is known of the hand-eye transform, where a model does not say.
        solver: The optimiser, where a model does not say.
        planes: What the held-out images are judged against. `known`: the recorded planes, for
            every model, also one that was fitted with `planes: unknown`. `unknown`: the recorded
            planes are only a start; a model that estimates walls is judged against the walls that
            it found in its training images. `auto`: `unknown` where `recording.yaml` says
            `planes: estimated`, else `known`. Also the value of a model that does not say.
        device: Where the passes over the pixels run: `cpu`, `cuda`, `cuda:1`, ...
    """

    models: tuple[ComparedModel, ...] = Field(min_length=1)
    seed: NonNegativeInt = 0
    hand_eye: HandEyeOptions = HandEyeOptions()
    solver: SolverOptions = SolverOptions()
    planes: PlaneChoice = "auto"
    device: str = "cpu"

    def training(self, model: ComparedModel) -> TrainingOptions:
        """Return the options that a model is fitted with: its own, completed by the common ones."""
        common = {
            name: getattr(self, name)
            for name in ("hand_eye", "solver", "planes", *MaskOptions.model_fields)
            if name not in model.model_fields_set
        }
        if model.planes == "auto":
            common["planes"] = self.planes
        return model.model_copy(update=common | {"device": self.device})

    def for_recordings(self, recordings: Iterable[Recording]) -> Self:
        """Return the options with `planes` as the recordings say, where it is `auto`."""
        return self.model_copy(update={"planes": resolved_planes(self.planes, recordings)})

    def against_garbage(self, inspection: Inspection | None) -> Self:
        """Return the options with the pixels and weights that a training would choose by itself.

        Where garbage bends a fit, all models are measured on the largest plane of each image, and
        fitted to it with robust weights. A model that chooses its pixels or robust weights keeps
        them, and so do options that choose the pixels.
        """
        chosen = self.mask != "recording" or self.outlier_window_mm is not None
        if inspection is None or not inspection.garbage_bends or chosen:
            return self
        masks = {"mask": "ransac", "mask_tolerance_mm": 1e3 * FAR_OFF}
        models = tuple(against_garbage(model, inspection) for model in self.models)
        return self.model_copy(update=masks | {"models": models})

    def to_mapping(self) -> dict[str, Any]:
        """Return plain values; of each model only the keys that it sets, as reading them needs."""
        models = [
            model.model_dump(mode="json", include=model.model_fields_set) for model in self.models
        ]
        return self.model_dump(mode="json") | {"models": models}


def masks_of(options: MaskOptions) -> MaskOptions:
    """Return only the options that say which pixels are used; equal ones compare as equal."""
    return MaskOptions(**{name: getattr(options, name) for name in MaskOptions.model_fields})
