"""What an evaluation can be told, and the headings of its columns."""

from typing import ClassVar, Self

from pydantic import Field, NonNegativeInt, PositiveFloat, model_validator

from tofcorr.error_terms.model import ErrorModelOptions
from tofcorr.estimation.solution import SolverOptions
from tofcorr.fit.residual_fit import ResidualOptions
from tofcorr.options import Options
from tofcorr.pixels.hand_eye import HandEyeOptions

BEFORE = "before"
"""The recorded hand-eye transform, and no depth correction."""

HAND_EYE_ONLY = "hand-eye only"
"""The hand-eye transform refitted, and no depth correction: the geometry's share."""


class NamedModel(Options):
    """One model of the comparison; the keys are those of a training configuration.

    Attributes:
        name: Its column's heading.
        model: The terms of its error.
        residual: A small network on top; null: none.
    """

    name: str = Field(min_length=1)
    model: ErrorModelOptions = ErrorModelOptions()
    residual: ResidualOptions | None = None


class RepeatOptions(Options):
    """Repeated random splits.

    Attributes:
        number: How many; 0 leaves them out.
        test_fraction: Share of the poses held out each time.
    """

    number: NonNegativeInt = 0
    test_fraction: float = Field(default=1 / 3, gt=0.0, lt=1.0)


class EvaluationOptions(Options):
    """Everything that `tofcorr evaluate` can be told.

    Attributes:
        models: The models to compare.
        seed: Seed of every random choice of frames.
        test_fraction: Share of the poses held out in the single split of the first table.
        folds: Folds of the cross-validation in the second table; 0 leaves it out.
        repeats: Further random splits.
        hand_eye: What is known of the hand-eye transform.
        solver: The optimiser.
        outlier_window_mm: Pixels whose raw error is further than this from the median raw error
            are not used; null uses all.
        device: Where the passes over the pixels run.
    """

    config_folder: ClassVar[str] = "evaluate"

    models: tuple[NamedModel, ...] = Field(min_length=1)
    seed: NonNegativeInt = 0
    test_fraction: float = Field(default=0.5, gt=0.0, lt=1.0)
    folds: NonNegativeInt = 6
    repeats: RepeatOptions = RepeatOptions()
    hand_eye: HandEyeOptions = HandEyeOptions()
    solver: SolverOptions = SolverOptions()
    outlier_window_mm: PositiveFloat | None = None
    device: str = "cpu"

    @model_validator(mode="after")
    def _check(self) -> Self:
        names = [BEFORE, HAND_EYE_ONLY, *(model.name for model in self.models)]
        twice = {name for name in names if names.count(name) > 1}
        if twice:
            raise ValueError(f"two columns would be called '{min(twice)}'; give each its own name")
        if self.folds == 1:
            raise ValueError("one fold leaves nothing to train on; expected 0 or at least 2 folds")
        return self

    @property
    def columns(self) -> list[str]:
        """The headings of the tables' columns."""
        return [BEFORE, HAND_EYE_ONLY, *(model.name for model in self.models)]
