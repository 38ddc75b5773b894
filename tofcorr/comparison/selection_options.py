"""What `tofcorr select` can be told."""

from typing import ClassVar, Literal, Self

from pydantic import Field, NonNegativeInt, PositiveFloat, model_validator

from tofcorr.comparison.evaluation_options import NamedModel
from tofcorr.estimation.solution import SolverOptions
from tofcorr.options import Options
from tofcorr.pixels.hand_eye import HandEyeOptions

Grouping = Literal["image", "distance", "target"]


class SelectionOptions(Options):
    """Everything that `tofcorr select` can be told.

    Attributes:
        models: The models to choose from.
        by: What is held out in turn: some images, a band of distances, a target. The first
            decides; the others show how far its choice carries.
        folds: Into how many parts images are dealt.
        distance_bands: Into how many bands of distance, of about as many images each.
        metric: Which error counts.
        seed: Seed of the dealing.
        hand_eye: What is known of the hand-eye transform.
        solver: The optimiser.
        outlier_window_mm: Pixels whose raw error is further than this from the median raw error
            are not used; null uses all.
        device: Where the passes over the pixels run.
    """

    config_folder: ClassVar[str] = "select"

    models: tuple[NamedModel, ...] = Field(min_length=1)
    by: tuple[Grouping, ...] = Field(default=("image", "distance", "target"), min_length=1)
    folds: int = Field(default=6, ge=2)
    distance_bands: int = Field(default=3, ge=2)
    metric: Literal["mean_abs", "rms"] = "mean_abs"
    seed: NonNegativeInt = 0
    hand_eye: HandEyeOptions = HandEyeOptions()
    solver: SolverOptions = SolverOptions()
    outlier_window_mm: PositiveFloat | None = None
    device: str = "cpu"

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
