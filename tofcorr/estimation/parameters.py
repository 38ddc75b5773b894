"""The unknowns as one vector: the hand-eye's twist, then the coefficients."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from tofcorr.geometry import se3


@dataclass(frozen=True)
class Parameters:
    """A point in the space of the unknowns.

    Attributes:
        tool_from_camera: The hand-eye transform, shape (4, 4).
        coefficients: Constant and coefficients of the error model, shape (K,), metres.
        hand_eye_is_free: Whether the hand-eye is estimated; it is fixed without a robot.
    """

    tool_from_camera: Float[Tensor, "4 4"]
    coefficients: Float[Tensor, "K"]
    hand_eye_is_free: bool = True

    @property
    def size(self) -> int:
        """How many unknowns there are."""
        return self.twist_size + self.coefficients.numel()

    @property
    def twist_size(self) -> int:
        """6 if the hand-eye is estimated, else 0."""
        return 6 if self.hand_eye_is_free else 0

    def moved(self, step: Float[Tensor, "P"]) -> "Parameters":
        """Return T exp(step[:6]) and coefficients + step[6:]; differentiable in the step (P,)."""
        transform = self.tool_from_camera
        if self.hand_eye_is_free:
            transform = transform @ se3.exp(step[:6])
        return replace(
            self,
            tool_from_camera=transform,
            coefficients=self.coefficients + step[self.twist_size :],
        )

    def detached(self) -> "Parameters":
        """Return the parameters without a gradient."""
        return replace(
            self,
            tool_from_camera=self.tool_from_camera.detach(),
            coefficients=self.coefficients.detach(),
        )

    def to(self, device: torch.device | str) -> "Parameters":
        """Return the parameters on a device."""
        return replace(
            self,
            tool_from_camera=self.tool_from_camera.to(device),
            coefficients=self.coefficients.to(device),
        )


HAND_EYE_SYMBOLS = ["t_x", "t_y", "t_z", "w_x", "w_y", "w_z"]
"""Names of the twist's entries: translation in metres, then rotation in radians, camera axes."""
