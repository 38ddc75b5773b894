"""The options of `select`."""

from typing import ClassVar, Literal, Self

from pydantic import Field, model_validator

from tofcorr.comparison.comparison_options import ComparisonOptions

Grouping = Literal["image", "distance", "target"]


class SelectionOptions(ComparisonOptions):
    """The options of `tofcorr select`.

    Attributes:
        by: What is held out in turn: some images, a band of distances, a target. The first
            decides; the others show whether its choice also extrapolates.
        folds: Number of groups into which the images are divided.
        distance_bands: Number of bands of distance, of about as many images each.
        metric: Which error counts.
    """

    config_folder: ClassVar[str] = "select"

    by: tuple[Grouping, ...] = Field(default=("image", "distance", "target"), min_length=1)
    folds: int = Field(default=6, ge=2)
    distance_bands: int = Field(default=3, ge=2)
    metric: Literal["mean_abs", "rms"] = "mean_abs"

    @model_validator(mode="after")
    def _each_once(self) -> Self:
        names = [model.name for model in self.models]
        given: tuple[tuple[str, list[str]], ...] = (
            ("model's name", names),
            ("grouping", [*self.by]),
        )
        for what, values in given:
            twice = [value for value in values if values.count(value) > 1]
            if twice:
                raise ValueError(f"every {what} may stand once, '{twice[0]}' stands twice")
        return self
