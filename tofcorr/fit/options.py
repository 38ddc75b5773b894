"""What a fit can be told: the terms, and how their parameters are found."""

from typing import Literal

from tofcorr.error_terms.model import ErrorModelOptions
from tofcorr.estimation.solution import SolverOptions
from tofcorr.fit.residual_fit import ResidualOptions
from tofcorr.fit.weighting import WeightOptions
from tofcorr.options import Options
from tofcorr.pixels.hand_eye import HandEyeOptions


class FitOptions(Options):
    """How one model is fitted to frames that are chosen already.

    Attributes:
        model: The terms of the error.
        residual: A small network on top, kept if held-out images are better with it; null: none.
        hand_eye: What is known of the hand-eye transform.
        solver: The optimiser.
        weights: How much each pixel counts.
        planes: `known`: the recorded planes are used as they are; `unknown`: the recorded ones are
            only a start, and every wall (frames of one target and one recorded plane) is estimated.
        free_directions: What becomes of a direction that the images do not determine: `prior`
            holds it near the start (100 mm, 100 mrad) and says so, `refuse` ends with a message.
        device: Where the pass over the pixels runs: `cpu`, `cuda`, `cuda:1`, ...
    """

    model: ErrorModelOptions
    residual: ResidualOptions | None = None
    hand_eye: HandEyeOptions = HandEyeOptions()
    solver: SolverOptions = SolverOptions()
    weights: WeightOptions = WeightOptions()
    planes: Literal["known", "unknown"] = "known"
    free_directions: Literal["prior", "refuse"] = "prior"
    device: str = "cpu"
