"""Covariance of the parameters, with the pose as the independent unit.

Pixels of one image share its pose error and its target, so counting them as independent makes
standard errors many times too small. Leaving out one pose at a time does not.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from tofcorr.errors import CalibrationDataError
from tofcorr.estimation.moments import ImageMoments
from tofcorr.estimation.objective import NormalEquations
from tofcorr.estimation.parameters import Parameters
from tofcorr.estimation.planes import Walls, joint_image_equations
from tofcorr.estimation.prior import Prior

# Curvature below this share of the largest (each parameter scaled to its own) is rounding: the
# direction is undetermined and left out of the covariance. Set by hand.
_RESOLVED = 1e-11
# Share of the largest curvature added where a pose is left out, so that a direction that only that
# pose determines can be solved for. Set by hand, well below _RESOLVED.
_RIDGE = 1e-13


@dataclass(frozen=True)
class Covariance:
    """Covariance of a step at the optimum, in the order of `Parameters.moved`.

    Attributes:
        matrix: Shape (P, P); metres and radians for the hand-eye (camera axes), metres for the
            coefficients.
        jackknife: The parameters' shift when one pose is left out, shape (G, P).
        undetermined_directions: How many directions the images do not determine; their variance
            is not in `matrix`.
    """

    matrix: Float[Tensor, "P P"]
    jackknife: Float[Tensor, "G P"]
    undetermined_directions: int

    @property
    def degrees_of_freedom(self) -> int:
        """Degrees of freedom of Student's t for estimate / standard error: poses less one."""
        return len(self.jackknife) - 1

    @property
    def standard_errors(self) -> Float[Tensor, "P"]:
        """Square roots of the diagonal, shape (P,)."""
        return self.matrix.diagonal().clamp(min=0).sqrt()


def jackknife_covariance(
    moments: ImageMoments,
    optimum: Parameters,
    prior: Prior | None = None,
    poses: Int[Tensor, "N"] | None = None,
    walls: Walls | None = None,
) -> Covariance:
    """Return the leave-one-pose-out covariance, from one Newton step per pose.

    It is the cluster-robust CRV3 estimator (Bell and McCaffrey 2002; MacKinnon, Nielsen and Webb
    2023), whose intervals keep about their nominal coverage with few poses.

    Args:
        moments: Moments of the images fitted.
        optimum: The parameters at the optimum.
        prior: The prior that was part of the loss; it counts as one more observation.
        poses: The pose of each image, shape (N,), counted from zero: images of one pose share its
            error and are left out together. None: every image has its own.
        walls: Walls that were estimated as well; the covariance allows for them.

    Raises:
        CalibrationDataError: There are fewer than three poses.
    """
    each = _by_pose(joint_image_equations(moments, optimum, walls), poses)
    if len(each.gradient) < 3:
        raise CalibrationDataError(
            f"Standard errors need at least 3 poses, got {len(each.gradient)}."
        )
    hessian = each.hessian.sum(dim=0)
    size = optimum.size
    if prior is not None:
        hessian[:size, :size] += prior.equations(optimum).hessian
    scale = hessian.diagonal().clamp(min=1e-300).sqrt()
    values, vectors = torch.linalg.eigh(hessian / scale[:, None] / scale[None, :])
    resolved = values > _RESOLVED * values.max()
    basis = vectors[:, resolved] / scale[:, None]
    left_out = (hessian - each.hessian).transpose(1, 2)
    reduced = basis.T @ left_out @ basis
    ridge = _RIDGE * reduced.diagonal(dim1=1, dim2=2).amax(dim=1)
    reduced = reduced + ridge[:, None, None] * torch.eye(reduced.shape[-1], dtype=reduced.dtype)
    # At the optimum the gradients sum to zero: without image i the rest has gradient -g_i.
    shift = torch.linalg.solve(reduced, (each.gradient @ basis)[:, :, None])[:, :, 0] @ basis.T
    shift = shift[:, :size]
    count = len(shift)
    centred = shift - shift.mean(dim=0)
    matrix = (count - 1) / count * centred.T @ centred
    if prior is not None:
        held = basis @ torch.linalg.solve(basis.T @ hessian @ basis, basis[:size].T)
        gain = held[:size] @ (prior.variance * prior.factor.T)
        matrix = matrix + gain @ gain.T
    return Covariance(matrix, shift, int((~resolved).sum()))


def _by_pose(each: NormalEquations, poses: Int[Tensor, "N"] | None) -> NormalEquations:
    """Add up the normal equations of the images of each pose."""
    if poses is None:
        return each
    count = int(poses.max()) + 1
    return NormalEquations(
        *(part.new_zeros(count, *part.shape[1:]).index_add_(0, poses, part) for part in each)
    )
