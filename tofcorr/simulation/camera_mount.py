"""Where the camera is mounted on the robot's tool, and what the recording says of it."""

import math
from typing import Self

import torch
from torch import Tensor

from tofcorr.geometry import se3
from tofcorr.options import Options
from tofcorr.simulation.numbers import NonNegativeNumber, Vector3


class MountGuessOptions(Options):
    """Distance of the recorded guess of the hand-eye transform from the true one."""

    translation_mm: NonNegativeNumber = 30.0
    rotation_deg: NonNegativeNumber = 5.0


class CameraMountOptions(Options):
    """The true hand-eye transform, and the guess of it in the recording.

    Attributes:
        translation_mm: Position of the camera in the tool frame.
        rotation_deg: Rotation vector: its direction is the axis, its length the angle.
        guess: Distance of the recorded guess from the truth, in a random direction; null: the guess
            is the identity.
    """

    translation_mm: Vector3 = (50.0, -20.0, 120.0)
    rotation_deg: Vector3 = (1.5, -2.0, 88.0)
    guess: MountGuessOptions | None = None

    def tool_from_camera(self) -> Tensor:
        """Return the true transform, shape (4, 4)."""
        rotation = torch.deg2rad(torch.tensor(self.rotation_deg, dtype=torch.float64))
        turned = se3.exp(torch.cat([torch.zeros(3, dtype=torch.float64), rotation]))
        translation = torch.tensor(self.translation_mm, dtype=torch.float64) * 1e-3
        return se3.assemble(turned[:3, :3], translation)

    @classmethod
    def from_matrix(cls, tool_from_camera: Tensor) -> Self:
        """Return the options whose truth is this transform (4, 4)."""
        rotation = se3.log(tool_from_camera.detach())[3:]
        return cls(
            translation_mm=tuple((tool_from_camera[:3, 3].detach() * 1e3).tolist()),
            rotation_deg=tuple(torch.rad2deg(rotation).tolist()),
        )


def perturbed(transform: Tensor, guess: MountGuessOptions, generator: torch.Generator) -> Tensor:
    """Return a transform that differs from `transform` by `guess`, in a random direction."""
    direction = torch.nn.functional.normalize(
        torch.randn(2, 3, generator=generator, dtype=torch.float64), dim=-1
    )
    zero = torch.zeros(3, dtype=torch.float64)
    turn = se3.exp(torch.cat([zero, direction[1] * math.radians(guess.rotation_deg)]))
    shift = transform[:3, 3] + direction[0] * guess.translation_mm * 1e-3
    return se3.assemble(transform[:3, :3] @ turn[:3, :3], shift)
