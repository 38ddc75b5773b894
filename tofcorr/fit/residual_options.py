"""Options of the residual network's training."""

from typing import Literal

from pydantic import Field, NonNegativeFloat, PositiveInt

from tofcorr.error_terms.residual import ResidualNetworkOptions
from tofcorr.options import Options


class ResidualOptions(Options):
    """How the residual network is trained, and when it is kept.

    Attributes:
        network: Its size and bound.
        pixels: How many pixels it is trained on, of all frames together.
        iterations: Most iterations of L-BFGS, of each of the two stages.
        weight_decay: Weight of the sum of squared network weights in a loss that is 1 without
            the network.
        joint: Whether hand-eye and coefficients are fitted once more together with the network.
            Without this, errors that the core cannot describe bias them.
        folds: Folds of the cross-validation that decides.
        keep: `if_better` drops a network that does not help on held-out images; `always` keeps it.
    """

    network: ResidualNetworkOptions = ResidualNetworkOptions()
    pixels: PositiveInt = 10_000
    iterations: PositiveInt = 200
    weight_decay: NonNegativeFloat = 1e-3
    joint: bool = True
    folds: int = Field(default=5, ge=2)
    keep: Literal["if_better", "always"] = "if_better"
