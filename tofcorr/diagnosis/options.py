"""The options of a diagnosis."""

from typing import Annotated, ClassVar, Literal

from pydantic import Field

from tofcorr.error_terms.model import ErrorModelOptions
from tofcorr.error_terms.pixel_terms import PixelPolynomialOptions
from tofcorr.error_terms.signal_terms import (
    AmplitudePolynomialOptions,
    DistancePolynomialOptions,
)
from tofcorr.options import Options

Share = Annotated[float, Field(gt=0, lt=1)]
Positive = Annotated[float, Field(gt=0)]


def _paper_model() -> ErrorModelOptions:
    return ErrorModelOptions(
        terms=(DistancePolynomialOptions(), PixelPolynomialOptions(), AmplitudePolynomialOptions())
    )


class TestOptions(Options):
    """How effects are tested and named.

    The sizes in millimetres are root mean squares over all pixels, held out. Unless another origin
    is given, the defaults were chosen by hand; `benchmarks.catalogue` measures what they lead to.

    Attributes:
        level: Significance level: the probability of naming an effect where none is missing. 5 % by
            convention.
        folds: Number of folds of the cross-validation. Whole poses are held out; for an effect that
            few images show, tiles of the images in which it would be strongest.
        flips: Number of draws of each null distribution, by sign flips or from a normal
            distribution. 299 resolve p-values to 1/300.
        least_images: With fewer poses, effects are ranked but not tested. The null distributions
            hold for any number of poses: of 60 recordings with four to seven poses and nothing
            missing, two had an effect named (`benchmarks.levels`, seed 90211).
        most_effects: Most effects that are named.
        material_mm: Minimum size that the first named effect must close. A wish: the test
            allows for it, so that the level is the same for any size.
        further_mm: Minimum size of a second or later effect.
        material_share: Minimum share of the squared gap that the first named effect must close, and
            every probe.
        form_tolerance_mm: A higher-order form of distance, pixel or amplitude term that closes less
            is added to the base model and not named.
        unknown_mm: Minimum size of an unknown effect that a probe detects.
        set_share: An effect that closes this share of what the named one closes belongs to the same
            cause set, as does one that closes not significantly less.
    """

    level: Share = 0.05
    folds: Annotated[int, Field(ge=2)] = 10
    flips: Annotated[int, Field(ge=19)] = 299
    least_images: Annotated[int, Field(ge=2)] = 5
    most_effects: Annotated[int, Field(ge=1)] = 8
    material_mm: Positive = 0.07
    further_mm: Positive = 0.3
    material_share: Share = 0.02
    form_tolerance_mm: Positive = 0.25
    unknown_mm: Positive = 0.5
    set_share: Share = 0.9


class DiagnosisOptions(Options):
    """All options of `tofcorr diagnose`: the keys of `configs/diagnose/*.yaml`.

    Attributes:
        seed: Of folds, sign flips and bootstraps.
        base: The error model under diagnosis. An error term that it lacks can be named like an
            effect. Every kind of term is allowed. Options that say `auto` are determined as in
            training. Amplitude terms are left out, with a warning, where no amplitude was recorded.
        catalogue: Names of the effects to consider; null: all.
        leave_out: Names of effects not to consider.
        hand_eye: `estimate` the hand-eye transform, keep it `fixed`, or `auto`: estimate it if a
            robot moves the camera.
        most_pixels: Number of pixels that are used at most; more are thinned out evenly.
        tests: How effects are tested and named.
        bootstraps: Number of resamples of the poses for every interval.
        target_gap_mm: Size of a gap that does not matter. What remains is called unknown only if it
            is significantly larger (p-value at most `tests.level`). Half the size is enough for
            what remains after named effects, for a bias along a covariate, and where an effect is
            significant but not named.
        pose_repeatability_mm: Pose scatter within this standard deviation does not make a cause
            unknown. `auto`: whatever scatter the data show, up to 3 mm and 3 mrad, as long as it
            depends on nothing recorded. State it where the data sheet of the robot and the survey
            of the target allow less.
        unknown_share: The cause is called unknown if more than this share of the squared gap or
            structure remains.
        simulate_anew: Whether to run the simulator with the effects, train corrections on it, and
            degrade ideal frames with the sensor that was found.
        page: Whether to draw report.html and the figures for TensorBoard. Without page and
            simulation a diagnosis takes half the time.
        threads: Number of threads that share an operation. One: tensors of `most_pixels` are so
            small that two threads take a third longer. null: as many as torch uses.
    """

    config_folder: ClassVar[str] = "diagnose"

    seed: Annotated[int, Field(ge=0)] = 1
    base: ErrorModelOptions = Field(default_factory=_paper_model)
    catalogue: tuple[str, ...] | None = None
    leave_out: tuple[str, ...] = ()
    hand_eye: Literal["auto", "estimate", "fixed"] = "auto"
    most_pixels: Annotated[int, Field(ge=1000)] = 100_000
    tests: TestOptions = TestOptions()
    bootstraps: Annotated[int, Field(ge=19)] = 200
    target_gap_mm: Positive = 1.0
    pose_repeatability_mm: Positive | Literal["auto"] = "auto"
    unknown_share: Share = 0.5
    simulate_anew: bool = True
    page: bool = True
    threads: Annotated[int, Field(ge=1)] | None = 1
