"""The options of `evaluate`, and the headings of its columns."""

from typing import ClassVar, Self

from pydantic import Field, NonNegativeInt, model_validator

from tofcorr.comparison.comparison_options import ComparisonOptions
from tofcorr.options import Options

BEFORE = "before"
"""The recorded hand-eye transform, and no depth correction."""

HAND_EYE_ONLY = "hand-eye only"
"""The hand-eye transform refitted, and no depth correction: what geometry alone explains."""


class RepeatOptions(Options):
    """Repeated random splits.

    Attributes:
        number: How many; 0 leaves them out.
        test_fraction: Share of the poses held out each time.
    """

    number: NonNegativeInt = 0
    test_fraction: float = Field(default=1 / 3, gt=0.0, lt=1.0)


class EvaluationOptions(ComparisonOptions):
    """The options of `tofcorr evaluate`.

    Attributes:
        test_fraction: Share of the poses held out in the single split of the first table.
        folds: Folds of the cross-validation in the second table; 0 leaves it out.
        repeats: Further random splits.
    """

    config_folder: ClassVar[str] = "evaluate"

    test_fraction: float = Field(default=0.5, gt=0.0, lt=1.0)
    folds: NonNegativeInt = 6
    repeats: RepeatOptions = RepeatOptions()

    @model_validator(mode="after")
    def _check(self) -> Self:
        twice = {name for name in self.columns if self.columns.count(name) > 1}
        if twice:
            raise ValueError(f"two columns would be called '{min(twice)}'; give each its own name")
        if self.folds == 1:
            raise ValueError("one fold leaves nothing to train on; expected 0 or at least 2 folds")
        return self

    @property
    def columns(self) -> list[str]:
        """The headings of the tables' columns."""
        return [BEFORE, HAND_EYE_ONLY, *(model.name for model in self.models)]

    @property
    def num_fits(self) -> int:
        """How many models are fitted to evaluate one set of images."""
        return (1 + self.folds + self.repeats.number) * len(self.models)
