"""The trainable transform and the residual that a calibration minimises."""

import pytest
import torch
from kinds_of_terms import built
from module.modules import CAMERA
from torch import Generator

from tofcorr.correction.model import CalibrationModel, HandEye
from tofcorr.geometry import se3
from tofcorr.geometry.rays import ray_directions


def transform(generator: Generator) -> torch.Tensor:
    return se3.exp(torch.randn(6, generator=generator, dtype=torch.float64))


def model_of(hand_eye: HandEye) -> CalibrationModel:
    terms = {"kind": "distance_polynomial"}, {"kind": "amplitude_polynomial"}
    return CalibrationModel(built(*terms), hand_eye)


def test_training_starts_at_the_guess_and_may_be_moved_or_fixed(generator: Generator) -> None:
    guess = transform(generator)
    torch.testing.assert_close(HandEye(guess)(), guess, rtol=0, atol=1e-15)
    assert not [p for p in HandEye(fixed=True).parameters() if p.requires_grad]


def test_rebasing_moves_the_guess_and_forgets_the_twist(generator: Generator) -> None:
    hand_eye, other = HandEye(transform(generator)), transform(generator)
    hand_eye.twist.data.copy_(torch.randn(6, generator=generator, dtype=torch.float64))
    hand_eye.rebase(other)
    torch.testing.assert_close(hand_eye(), other, rtol=0, atol=1e-15)
    assert not hand_eye.twist.any()


def test_what_is_no_rigid_transform_is_refused() -> None:
    mirrored = torch.diag(torch.tensor([1.0, 1.0, -1.0, 1.0]))
    for wrong in (torch.zeros(4, 4), 2 * torch.eye(4), mirrored, torch.eye(3)):
        with pytest.raises(ValueError, match=r"A hand-eye transform: .* (rotation|4x4|0 0 0 1)"):
            HandEye(wrong)


def test_the_residual_is_the_distance_of_a_point_to_the_plane(generator: Generator) -> None:
    """Written out pixel by pixel, without the model's rearrangement."""
    tool_from_camera = transform(generator)
    model = model_of(HandEye(tool_from_camera))
    model.error.set_coefficient_vector(torch.linspace(-0.02, 0.03, 6, dtype=torch.float64))
    rays = ray_directions(CAMERA)
    distance = 0.5 + torch.rand(2, 5, 7, generator=generator, dtype=torch.float64)
    amplitude = 10 + 80 * torch.rand(2, 5, 7, generator=generator, dtype=torch.float64)
    normal = torch.nn.functional.normalize(torch.randn(2, 3, generator=generator).double(), dim=-1)
    offset = torch.randn(2, generator=generator, dtype=torch.float64)
    residual = model.residual(distance, amplitude, rays, normal, offset)
    error = model.error(distance, amplitude)
    for b, row, column in ((0, 0, 0), (1, 2, 3), (0, 1, 2)):
        point = rays[row, column] * (distance - error)[b, row, column]
        in_tool = tool_from_camera[:3, :3] @ point + tool_from_camera[:3, 3]
        expected = normal[b] @ in_tool + offset[b]
        torch.testing.assert_close(residual[b, row, column], expected)
