"""The options of a fit: the terms, and how their parameters are found."""

from typing import Literal

from tofcorr.error_terms.model import ErrorModelOptions
from tofcorr.estimation.solution import SolverOptions
from tofcorr.fit.residual_fit import ResidualOptions
from tofcorr.fit.weighting import WeightOptions
from tofcorr.options import Options
from tofcorr.pixels.hand_eye import HandEyeOptions
from tofcorr.pixels.plane_choice import PlaneChoice


class FitOptions(Options):
    """How one model is fitted to given frames.

    Attributes:
        model: The terms of the error.
        residual: A small network on what the terms leave, kept if it improves held-out images;
            null: none.
        hand_eye: Whether the hand-eye transform is estimated, and where its estimate starts.
        solver: The optimiser.
        weights: The weight of each pixel.
        planes: `known`: the recorded planes are used as they are; `unknown`: every wall (frames of
            one target and one recorded plane) is estimated, from the recorded plane as a start;
            `auto`: `unknown` where `recording.yaml` says `planes: estimated`, else `known`.
        free_directions: How to treat a direction that the images do not determine: `prior` holds
            it near the start (standard deviation 100 mm, 100 mrad) and warns; `refuse` is an
            error.
        remove_noise_shift: Whether hand-eye transform and coefficients are moved back by what the
            noise of the measured distances has moved them; false leaves them where the loss is
            least.
        device: Where the pass over the pixels runs: `cpu`, `cuda`, `cuda:1`, ...
    """

    model: ErrorModelOptions
    residual: ResidualOptions | None = None
    hand_eye: HandEyeOptions = HandEyeOptions()
    solver: SolverOptions = SolverOptions()
    weights: WeightOptions = WeightOptions()
    planes: PlaneChoice = "auto"
    free_directions: Literal["prior", "refuse"] = "prior"
    remove_noise_shift: bool = True
    device: str = "cpu"
