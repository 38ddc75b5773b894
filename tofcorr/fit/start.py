"""Where the solver starts: the better of a closed form and the recording's own guess."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from tofcorr.estimation.initial_guess import initial_parameters, with_linear_part
from tofcorr.estimation.moments import ImageMoments
from tofcorr.estimation.objective import MomentObjective
from tofcorr.estimation.parameters import Parameters
from tofcorr.pixels.dataset import Dataset
from tofcorr.pixels.hand_eye import HandEyeOptions, hand_eye_is_free, recorded_hand_eye


@dataclass(frozen=True)
class Start:
    """Gives a start for the solver, whichever of the model's columns the moments hold.

    Attributes:
        recorded: tool_from_camera as the recording has it, shape (4, 4), float64, metres.
        hand_eye_is_free: Whether the hand-eye transform is estimated.
        tries_closed_form: Whether the closed form from plane normals is tried as well.
        resumed: Where an earlier fit stood; None starts anew.
    """

    recorded: Tensor
    hand_eye_is_free: bool
    tries_closed_form: bool
    resumed: Parameters | None = None

    @staticmethod
    def of(dataset: Dataset, options: HandEyeOptions, resumed: Parameters | None = None) -> "Start":
        """Return the start that the recordings and the options give."""
        return Start(
            recorded=recorded_hand_eye(dataset),
            hand_eye_is_free=hand_eye_is_free(dataset, options),
            tries_closed_form=options.start == "auto",
            resumed=resumed,
        )

    def resumed_at(self, parameters: Parameters | None) -> "Start":
        """Return the start at parameters found earlier; None: without any."""
        return replace(self, resumed=parameters)

    def __call__(self, moments: ImageMoments) -> Parameters:
        """Return where the solver starts on these moments.

        The resumed parameters, if there are any with as many coefficients as the moments have
        columns; otherwise the candidate of least loss.
        """
        resumed = self.resumed
        if resumed is not None and resumed.coefficients.numel() == moments.num_coefficients:
            return resumed
        candidates = [with_linear_part(moments, self.guess(moments))]
        if self.hand_eye_is_free and self.tries_closed_form:
            candidates.append(initial_parameters(moments, self.recorded))
        objective = MomentObjective(moments)
        return min(candidates, key=lambda candidate: float(objective.loss(candidate)))

    def guess(self, moments: ImageMoments) -> Parameters:
        """Return the recorded hand-eye transform and no error: the centre of the prior."""
        zero = torch.zeros(moments.num_coefficients, dtype=torch.float64)
        return Parameters(self.recorded, zero, self.hand_eye_is_free)
