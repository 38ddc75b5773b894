"""The trainable transform and the residual that a calibration minimises."""

import pytest
import torch

from tofcorr.correction.model import CalibrationModel, HandEye
from tofcorr.error_terms.base import Domain, Interval
from tofcorr.error_terms.model import ErrorModel, ErrorModelOptions
from tofcorr.geometry import se3
from tofcorr.geometry.camera import CameraIntrinsics
from tofcorr.geometry.rays import ray_directions

CAMERA = CameraIntrinsics(
    width=4, height=3, matrix=((5.0, 0.0, 1.6), (0.0, 5.0, 1.1), (0.0, 0.0, 1.0))
)


def transform(generator: torch.Generator) -> torch.Tensor:
    return se3.exp(torch.randn(6, generator=generator, dtype=torch.float64))


def model_of(hand_eye: HandEye) -> CalibrationModel:
    domain = Domain(
        height=3, width=4, radial_distance=Interval(0.5, 2.0), amplitude=Interval(10.0, 90.0),
        normalised_amplitude=Interval(10.0, 90.0),
    )  # fmt: skip
    terms = [{"kind": "distance_polynomial"}, {"kind": "amplitude_polynomial"}]
    options = ErrorModelOptions.from_mapping({"terms": terms}, "test")
    return CalibrationModel(ErrorModel(options, domain), hand_eye)


def test_training_starts_at_the_guess(generator: torch.Generator) -> None:
    guess = transform(generator)
    torch.testing.assert_close(HandEye(guess)(), guess, rtol=0, atol=1e-15)


def test_rebasing_moves_the_guess_and_forgets_the_twist(generator: torch.Generator) -> None:
    hand_eye, other = HandEye(transform(generator)), transform(generator)
    hand_eye.twist.data.copy_(torch.randn(6, generator=generator, dtype=torch.float64))
    hand_eye.rebase(other)
    torch.testing.assert_close(hand_eye(), other, rtol=0, atol=1e-15)
    assert not hand_eye.twist.any()


def test_a_fixed_transform_is_not_estimated() -> None:
    assert HandEye(fixed=True).fixed
    assert not [p for p in HandEye(fixed=True).parameters() if p.requires_grad]


@pytest.mark.parametrize(
    "wrong",
    [torch.zeros(4, 4), 2 * torch.eye(4), torch.diag(torch.tensor([1.0, 1.0, -1.0, 1.0]))],
    ids=["zero", "scaled", "mirrored"],
)
def test_what_is_no_rigid_transform_is_refused(wrong: torch.Tensor) -> None:
    with pytest.raises(ValueError, match="a rotation and a translation"):
        HandEye(wrong)


def test_a_wrong_shape_is_refused() -> None:
    with pytest.raises(ValueError, match=r"shape \(4, 4\), got \(3, 3\)"):
        HandEye(torch.eye(3))


def test_residual_is_the_distance_of_the_corrected_point_to_the_plane(
    generator: torch.Generator,
) -> None:
    """Written out pixel by pixel, without the model's rearrangement."""
    tool_from_camera = transform(generator)
    model = model_of(HandEye(tool_from_camera))
    model.error.set_coefficient_vector(torch.linspace(-0.02, 0.03, 6, dtype=torch.float64))
    rays = ray_directions(CAMERA)
    distance = 0.5 + torch.rand(2, 3, 4, generator=generator, dtype=torch.float64)
    amplitude = 10 + 80 * torch.rand(2, 3, 4, generator=generator, dtype=torch.float64)
    normal = torch.nn.functional.normalize(
        torch.randn(2, 3, generator=generator, dtype=torch.float64), dim=-1
    )
    offset = torch.randn(2, generator=generator, dtype=torch.float64)
    residual = model.residual(distance, amplitude, rays, normal, offset)
    error = model.error(distance, amplitude)
    for b, row, column in ((0, 0, 0), (1, 2, 3), (0, 1, 2)):
        point = rays[row, column] * (distance - error)[b, row, column]
        in_tool = tool_from_camera[:3, :3] @ point + tool_from_camera[:3, 3]
        expected = normal[b] @ in_tool + offset[b]
        torch.testing.assert_close(residual[b, row, column], expected)


def test_residual_has_exact_derivatives(generator: torch.Generator) -> None:
    model = model_of(HandEye(transform(generator)))
    rays = ray_directions(CAMERA)
    distance = 0.5 + torch.rand(1, 3, 4, generator=generator, dtype=torch.float64)
    amplitude = 10 + 80 * torch.rand(1, 3, 4, generator=generator, dtype=torch.float64)
    normal = torch.tensor([[0.0, 0.6, 0.8]], dtype=torch.float64)
    offset = torch.tensor([0.3], dtype=torch.float64)
    names = [name for name, _ in model.named_parameters()]
    values = [0.1 * torch.randn(p.shape, generator=generator).double() for p in model.parameters()]

    def residual(*parameters: torch.Tensor) -> torch.Tensor:
        given = dict(zip(names, parameters, strict=True))
        arguments = (distance, amplitude, rays, normal, offset)
        return torch.func.functional_call(_Residual(model), _prefixed(given), arguments)

    assert torch.autograd.gradcheck(residual, [value.requires_grad_() for value in values])


def test_a_model_without_amplitudes_names_what_it_lacks() -> None:
    model = model_of(HandEye())
    nothing = torch.ones(1, 3, 4, dtype=torch.float64)
    normal, offset = torch.tensor([[0.0, 0.0, 1.0]]).double(), torch.zeros(1).double()
    with pytest.raises(ValueError, match="expected amplitudes"):
        model.residual(nothing, None, ray_directions(CAMERA), normal, offset)


class _Residual(torch.nn.Module):
    """The residual as a module's forward, which `functional_call` needs."""

    def __init__(self, model: CalibrationModel) -> None:
        super().__init__()
        self.model = model

    def forward(self, *arguments: torch.Tensor) -> torch.Tensor:
        return self.model.residual(*arguments)


def _prefixed(parameters: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    return {f"model.{name}": value for name, value in parameters.items()}
