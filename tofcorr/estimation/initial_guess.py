"""A hand-eye transform without a guess: rotation from plane normals, then the rest linearly."""

import torch
from jaxtyping import Float
from torch import Tensor

from tofcorr.estimation.curvature import curved
from tofcorr.estimation.moments import ImageMoments
from tofcorr.estimation.objective import MomentObjective
from tofcorr.estimation.parameters import Parameters
from tofcorr.geometry import se3

# Weight of the guess against the normals, in images: it only decides rotations that the normals do
# not determine. Set by hand.
_GUESS_WEIGHT = 1e-6
# Curvature below this share of the largest (each unknown scaled to its own) is rounding: the
# direction is undetermined. Set by hand, as in `lbfgs`.
_RESOLVED = 1e-12


def plane_normals_camera(moments: ImageMoments) -> Float[Tensor, "N 3"]:
    """Fit a plane to the raw points of each image, from its moments.

    Returns:
        Unit normals in the camera frame, on the camera's side of the plane, shape (N, 3).
    """
    total = moments.gram[:, -1, -1].clamp(min=1e-300)
    mean = moments.gram[:, -1, :3] / total[:, None]
    second = moments.gram[:, :3, :3] / total[:, None, None]
    covariance = second - mean[:, :, None] * mean[:, None, :]
    normal = torch.linalg.eigh(covariance).eigenvectors[..., 0]
    # The camera is the origin: it lies at signed distance -n.mean, which must be positive.
    facing = torch.where((normal * mean).sum(-1) > 0, -1.0, 1.0)
    return normal * facing[:, None]


def rotation_from_normals(
    normal_tool: Float[Tensor, "N 3"],
    normal_camera: Float[Tensor, "N 3"],
    guess: Float[Tensor, "3 3"],
) -> Float[Tensor, "3 3"]:
    """Return the rotation tool_from_camera that best turns camera normals into tool normals.

    Args:
        normal_tool: Unit normals in the tool frame, shape (N, 3).
        normal_camera: The same normals in the camera frame, shape (N, 3).
        guess: A rotation, shape (3, 3); decides the turn about the normal where all normals are
            parallel.
    """
    outer = torch.einsum("na,nb->ab", normal_tool, normal_camera) + _GUESS_WEIGHT * guess
    u, _, vh = torch.linalg.svd(outer)
    sign = torch.ones(3, dtype=outer.dtype)
    sign[2] = torch.det(u @ vh).sign()
    return u @ torch.diag(sign) @ vh


def initial_parameters(
    moments: ImageMoments, guess: Float[Tensor, "4 4"] | None = None
) -> Parameters:
    """Return a start for the solvers that needs no guess of the hand-eye.

    Args:
        moments: Moments of the images.
        guess: A transform for directions that the images do not determine, shape (4, 4); None:
            the identity.
    """
    guess = torch.eye(4, dtype=torch.float64) if guess is None else guess.to(torch.float64)
    rotation = rotation_from_normals(
        moments.normal_tool, plane_normals_camera(moments), guess[:3, :3]
    )
    transform = se3.assemble(rotation, guess[:3, 3])
    zero = torch.zeros(moments.num_coefficients, dtype=torch.float64)
    return with_linear_part(moments, Parameters(transform, zero))


def with_linear_part(moments: ImageMoments, start: Parameters) -> Parameters:
    """Solve for translation and coefficients with the rotation fixed: one least-squares problem.

    With a fixed hand-eye only the coefficients are solved for. Directions that the images do not
    determine keep the values of `start`.
    """
    equations = MomentObjective(moments).normal_equations(start)
    solved_for = curved(equations.hessian)
    if start.hand_eye_is_free:
        solved_for[3:6] = False  # The rotation.
    linear = torch.nonzero(solved_for)[:, 0]
    if not len(linear):
        return start
    hessian = equations.hessian[linear[:, None], linear[None, :]]
    scale = hessian.diagonal().clamp(min=1e-300).sqrt()
    values, vectors = torch.linalg.eigh(hessian / scale[:, None] / scale[None, :])
    resolved = values > _RESOLVED * values.max()
    basis = vectors[:, resolved] / scale[:, None]
    solved = -(basis / values[resolved]) @ (basis.T @ equations.gradient[linear])
    # The solution of least length in metres. In scaled units an undetermined translation, whose own
    # scale is almost zero, would take most of the others' steps.
    undetermined = torch.linalg.qr(vectors[:, ~resolved] / scale[:, None]).Q
    step = torch.zeros(start.size, dtype=torch.float64)
    step[linear] = solved - undetermined @ (undetermined.T @ solved)
    return start.moved(step).detached()
