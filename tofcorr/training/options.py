"""The options of a training, as YAML gives them."""

from typing import Literal

from pydantic import Field, NonNegativeInt, PositiveFloat

from tofcorr.error_terms.model import ErrorModelOptions
from tofcorr.estimation.solution import SolverOptions
from tofcorr.options import Options
from tofcorr.training.residual_fit import ResidualOptions
from tofcorr.training.weighting import WeightOptions


class HandEyeOptions(Options):
    """What is known of the hand-eye transform.

    Attributes:
        estimate: `auto` estimates it if the tool moves, and holds the identity without a robot.
        start: `auto` needs no guess (closed form from plane normals) and also tries the
            recording's own; `recording` starts from the recording's alone.
    """

    estimate: Literal["auto", "yes", "no"] = "auto"
    start: Literal["auto", "recording"] = "auto"


class SplitOptions(Options):
    """Which frames are held out; frames of one pose always stay together.

    Attributes:
        test_fraction: Share of the poses that is held out; 0 trains on everything.
        seed: Seed of the random choice.
    """

    test_fraction: float = Field(default=0.5, ge=0.0, lt=1.0)
    seed: NonNegativeInt = 0


class TrainingOptions(Options):
    """Everything that `tofcorr train` can be told.

    Attributes:
        name: The model's name in reports.
        model: The terms of the error.
        residual: A small network on top, kept if held-out images are better with it; null: none.
        hand_eye: What is known of the hand-eye transform.
        solver: The optimiser.
        split: The frames held out.
        outlier_window_mm: Pixels whose raw error (before any fit) is further than this from the
            median raw error are not used; null uses all.
        edge_contrast: Pixels are left out whose 3 x 3 neighbourhood is brighter by this factor at
            one place than at another; null keeps them.
        grazing_deg: Pixels are left out that see the wall at a larger angle from its normal; null
            keeps them.
        weights: How much each pixel counts.
        planes: `known`: the recorded planes are believed; `unknown`: the recorded ones are only a
            start, and every wall (frames of one target and one recorded plane) is estimated.
        mask: `recording`: pixels look at the wall where mask.npy says so, or everywhere without
            it; `ransac`: where they lie on the largest plane of their image.
        mask_tolerance_mm: How far a pixel may lie from that plane.
        free_directions: What becomes of a direction that the images leave free: `prior` holds it
            near the start (100 mm, 100 mrad) and says so, `refuse` ends with a message.
        advice: On how many further poses the report gives advice; 0: on none.
        device: Where the pass over the pixels runs: `cpu`, `cuda`, `cuda:1`, ...
    """

    name: str
    model: ErrorModelOptions
    residual: ResidualOptions | None = None
    hand_eye: HandEyeOptions = HandEyeOptions()
    solver: SolverOptions = SolverOptions()
    split: SplitOptions = SplitOptions()
    outlier_window_mm: PositiveFloat | None = None
    edge_contrast: float | None = Field(default=None, gt=1.0)
    grazing_deg: float | None = Field(default=None, gt=0.0, lt=90.0)
    weights: WeightOptions = WeightOptions()
    planes: Literal["known", "unknown"] = "known"
    mask: Literal["recording", "ransac"] = "recording"
    mask_tolerance_mm: PositiveFloat = 30.0
    free_directions: Literal["prior", "refuse"] = "prior"
    advice: NonNegativeInt = 5
    device: str = "cpu"
