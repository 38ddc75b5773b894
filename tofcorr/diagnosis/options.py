"""The options of a diagnosis."""

from typing import Annotated, ClassVar, Literal

from pydantic import Field

from tofcorr.error_terms.model import ErrorModelOptions
from tofcorr.error_terms.pixel_terms import PixelPolynomialOptions
from tofcorr.error_terms.signal_terms import (
    AmplitudePolynomialOptions,
    DistancePolynomialOptions,
)
from tofcorr.options import Options, among
from tofcorr.simulation.effects import CATALOGUE

Share = Annotated[float, Field(gt=0, lt=1)]
Positive = Annotated[float, Field(gt=0)]
EffectName = Annotated[str, among(CATALOGUE, "effect")]


class TestOptions(Options):
    """How effects are named and tested.

    Attributes:
        odds: Prior odds that an effect is missing. Small: a recording is tested for some thirty. A
            third or three times as much named the same (`benchmarks.levels`, seed 4242).
        named_from: Probability from which on something is said to be there: more probable than not.
        cover: Probability that a cause set holds, given the other effects. By convention.
        level: Significance level of biases along covariates. 5 % by convention.
        flips: Number of sign flips of that test. 299 resolve p-values to 1/300.
        folds: Number of parts of the recording that a map of the image is predicted from in turn.
        least_images: With fewer poses, effects are ranked but none is named.
        most_effects: Most effects that are named.
        material_mm: The largest effect must add this to be named: the root mean square beside the
            others and beyond what calibration absorbs. A wish.
        further_mm: Each further effect must add this. So must a change of a parameter of the
            simulator, which otherwise stays as it is,
        material_share: and close this share of the squared gap.
        form_tolerance_mm: A finer form of a base term must add this, and every effect where a
            simulator's error was fitted at other poses, to which it is carried with a form error.
    """

    odds: Share = 0.00015
    named_from: Share = 0.5
    cover: Share = 0.9
    level: Share = 0.05
    folds: Annotated[int, Field(ge=2)] = 10
    flips: Annotated[int, Field(ge=19)] = 299
    least_images: Annotated[int, Field(ge=2)] = 5
    most_effects: Annotated[int, Field(ge=1)] = 4
    material_mm: Positive = 0.07
    form_tolerance_mm: Positive = 0.25
    further_mm: Positive = 0.3
    material_share: Share = 0.02


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
    base: ErrorModelOptions = ErrorModelOptions(
        terms=(DistancePolynomialOptions(), PixelPolynomialOptions(), AmplitudePolynomialOptions())
    )
    catalogue: tuple[EffectName, ...] | None = None
    leave_out: tuple[EffectName, ...] = ()
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
