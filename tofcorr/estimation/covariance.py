"""Covariance of the parameters, with the pose as the independent unit.

Pixels of one image share its pose error and its target, so counting them as independent makes
standard errors many times too small. Leaving out one pose at a time does not.
"""

from dataclasses import dataclass

from jaxtyping import Float, Int
from torch import Tensor

from tofcorr.errors import CalibrationDataError
from tofcorr.estimation.linear import left_out_steps, robust_covariance
from tofcorr.estimation.moments import ImageMoments
from tofcorr.estimation.parameters import Parameters
from tofcorr.estimation.planes import Walls, joint_image_equations
from tofcorr.estimation.prior import Prior


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
    each = joint_image_equations(moments, optimum, walls).by_pose(poses)
    if len(each.gradient) < 3:
        raise CalibrationDataError(
            f"Standard errors need at least 3 poses, got {len(each.gradient)}."
        )
    size = optimum.size
    own = None if prior is None else prior.equations(optimum)
    shift, curvature = left_out_steps(each, each.total().plus(own).hessian)
    shift = shift[:, :size]
    matrix = robust_covariance(shift)
    if prior is not None:
        gain = curvature.inverse[:size, :size] @ (prior.variance * prior.factor.T)
        matrix = matrix + gain @ gain.T
    return Covariance(matrix, shift, int((~curvature.resolved).sum()))
