"""What can be chosen about a diagnosis."""

from typing import Annotated, ClassVar, Literal

from pydantic import Field

from tofcorr.error_terms.amplitude import AmplitudePolynomialOptions
from tofcorr.error_terms.distance import DistancePolynomialOptions
from tofcorr.error_terms.model import ErrorModelOptions
from tofcorr.error_terms.pixel import PixelPolynomialOptions
from tofcorr.options import Options

Share = Annotated[float, Field(gt=0, lt=1)]
Positive = Annotated[float, Field(gt=0)]


def _paper_model() -> ErrorModelOptions:
    return ErrorModelOptions(
        terms=(
            DistancePolynomialOptions(),
            PixelPolynomialOptions(),
            AmplitudePolynomialOptions(),
        )
    )


class TestOptions(Options):
    """How effects are tested and named.

    Attributes:
        level: Probability of naming an effect where there is none.
        folds: Of the cross-validation; whole poses are held out (of an effect that few images show,
            tiles of the images in which it would be strongest).
        flips: Sign flips that make the null distribution.
        least_images: With fewer poses effects are ranked, not tested.
        most_effects: No more are named.
        material_mm: A named effect closes at least so much, root mean square.
        further_mm: And so much if another was named before: what that one's form leaves is small.
        material_share: And at least this share of the squared gap.
        form_tolerance_mm: What a base term of a stiff form may leave unexplained: a finer form of
            distance, pixel or amplitude that closes less is taken into the base model, not named.
        unknown_mm: Marks of unknown effects that close less are not looked at.
        set_share: An effect that closes this share of what the named one closes stands beside it
            in the set of causes, as does one that is not significantly worse.
    """

    level: Share = 0.05
    folds: Annotated[int, Field(ge=2)] = 10
    flips: Annotated[int, Field(ge=19)] = 299
    least_images: Annotated[int, Field(ge=2)] = 25
    most_effects: Annotated[int, Field(ge=1)] = 8
    material_mm: Positive = 0.07
    further_mm: Positive = 0.3
    material_share: Share = 0.02
    form_tolerance_mm: Positive = 0.25
    unknown_mm: Positive = 0.5
    set_share: Share = 0.9


class DiagnosisOptions(Options):
    """All options of `tofcorr diagnose`: what `configs/diagnose/*.yaml` holds.

    Attributes:
        seed: Of folds, sign flips and bootstraps.
        base: The error model under diagnosis; an effect it lacks can be named. Amplitude terms are
            left out, with a warning, where no amplitude was recorded.
        catalogue: Names of the effects to consider; null: all.
        leave_out: Names of effects not to consider.
        hand_eye: `estimate` it, keep it `fixed`, or `auto`: estimate where a robot moves.
        most_pixels: More are thinned out evenly.
        tests: How effects are tested and named.
        bootstraps: Resamplings of the poses behind every interval.
        target_gap_mm: A gap counts as closed if its interval ends below.
        pose_repeatability_mm: So much may the offset of a pose scatter without being a gap: what
            the robot's data sheet and the target's survey allow.
        unknown_share: A cause is unknown if this share of the structure remains unexplained.
        simulate_anew: Run the simulator with the effects, and train corrections on it.
        page: Draw report.html and the figures for TensorBoard. Without these two a diagnosis takes
            half the time: for many recordings.
    """

    config_folder: ClassVar[str] = "diagnose"

    seed: Annotated[int, Field(ge=0)] = 1
    base: ErrorModelOptions = Field(default_factory=_paper_model)
    catalogue: tuple[str, ...] | None = None
    leave_out: tuple[str, ...] = ()
    hand_eye: Literal["auto", "estimate", "fixed"] = "auto"
    most_pixels: Annotated[int, Field(ge=1000)] = 200_000
    tests: TestOptions = TestOptions()
    bootstraps: Annotated[int, Field(ge=19)] = 200
    target_gap_mm: Positive = 1.0
    pose_repeatability_mm: Positive = 0.6
    unknown_share: Share = 0.5
    simulate_anew: bool = True
    page: bool = True
