"""What the simulator under diagnosis measures in the chosen pixels, split from the geometry."""

from dataclasses import dataclass, replace

from torch import Tensor

from tofcorr.diagnosis.sums.observations import Observations
from tofcorr.diagnosis.sums.prediction import predicted_distance


@dataclass(frozen=True, kw_only=True)
class SimulatorError:
    """The error that a simulator makes at the M chosen pixels.

    Attributes:
        error: Simulated less true distance, shape (M,), metres; NaN where the simulator has no
            distance, or is not known.
        sigma: Standard deviation of its noise, shape (M,), metres.
        tool_from_camera: The simulator's own hand-eye transform, which is exact, shape (4, 4).
        uncertain: What remains uncertain of the error and is the same in all pixels: columns for
            coefficients of variance one, shape (M, J), metres. J is 0 where the simulator was
            seen at the recording's own poses.
        carried: Whether it was fitted at other poses and carried to these, so that the form of the
            fit matters.
    """

    error: Tensor
    sigma: Tensor
    tool_from_camera: Tensor
    uncertain: Tensor
    carried: bool = False

    def at(self, pixels: Tensor | slice) -> "SimulatorError":
        """Return the same at some of the pixels."""
        return replace(
            self,
            error=self.error[pixels],
            sigma=self.sigma[pixels],
            uncertain=self.uncertain[pixels],
        )

    def residual(self, observations: Observations) -> Tensor:
        """Return measured less simulated distance, the simulator as given, shape (M,), metres."""
        predicted = predicted_distance(observations, self.tool_from_camera)
        return observations.measured - predicted - self.error
