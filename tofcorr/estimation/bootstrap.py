r"""Standard errors by resampling the poses with replacement, from the moments alone.

The residual is linear in :math:`\Phi = (b \otimes R, t, 1)`, which does not depend on the plane
that an image shows. So the images of a resample add up to one matrix in :math:`\Phi`, and a
thousand resamples are fitted by a few batched Newton steps.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from tofcorr.errors import CalibrationDataError
from tofcorr.estimation.linear import NormalEquations
from tofcorr.estimation.moments import ImageMoments
from tofcorr.estimation.objective import MomentObjective
from tofcorr.estimation.observability import QuadraticPrior
from tofcorr.estimation.parameters import Parameters
from tofcorr.geometry import se3

# Newton steps after the linear solution. Each squares the remaining distance to the optimum, so one
# is enough; `Bootstrap.last_step` measures what remains.
_NEWTON_STEPS = 1
# Share of each curvature added, so that a resample of few distinct images can be solved. Set by
# hand, well below any curvature that matters.
_RIDGE = 1e-12
# Entries of the resamples' matrices held at once: 32 MB. Set by hand.
_CHUNK_ENTRIES = 4_000_000
# Fewest poses of a bootstrap. Set by hand: two poses allow only four different draws.
_FEWEST_BLOCKS = 3


@dataclass(frozen=True)
class Bootstrap:
    """The results of resampled recordings.

    Attributes:
        steps: Steps from the optimum of all images to the optimum of each resample, as
            `Parameters.moved` takes them, shape (B, P).
        last_step: Median length of the last Newton step, in standard deviations of the steps; the
            distance left to the optimum is about its square.
    """

    steps: Float[Tensor, "B P"]
    last_step: float

    @property
    def covariance(self) -> Float[Tensor, "P P"]:
        """Covariance of the step, shape (P, P)."""
        return torch.cov(self.steps.T)

    def interval(self, level: float = 0.95) -> Float[Tensor, "2 P"]:
        """Return lower and upper end of each unknown's percentile interval, shape (2, P)."""
        tail = (1 - level) / 2
        return self.steps.quantile(torch.tensor([tail, 1 - tail], dtype=torch.float64), dim=0)


def draw_block_weights(
    groups: Int[Tensor, "N"], num_resamples: int, generator: torch.Generator
) -> Float[Tensor, "{num_resamples} N"]:
    """Draw how often each image counts when whole blocks are drawn with replacement.

    Args:
        groups: The block of each image, shape (N,), from zero; images of one pose share it.
        num_resamples: How many resamples B.
        generator: Source of randomness.

    Returns:
        Shape (num_resamples, N), float64.

    Raises:
        CalibrationDataError: There are fewer than three blocks.
    """
    num_blocks = int(groups.max()) + 1 if len(groups) else 0
    if num_blocks < _FEWEST_BLOCKS:
        raise CalibrationDataError(
            f"A bootstrap needs at least {_FEWEST_BLOCKS} poses, got {num_blocks}."
        )
    drawn = torch.randint(num_blocks, (num_resamples, num_blocks), generator=generator)
    counts = torch.zeros(num_resamples, num_blocks, dtype=torch.float64)
    counts.scatter_add_(1, drawn, torch.ones_like(drawn, dtype=torch.float64))
    return counts[:, groups]


def bootstrap(
    moments: ImageMoments,
    optimum: Parameters,
    weights: Float[Tensor, "B N"],
    prior: QuadraticPrior | None = None,
) -> Bootstrap:
    """Fit resampled recordings, all at once.

    Args:
        moments: Moments of the images fitted.
        optimum: The parameters at the optimum of all images.
        weights: How often each image counts in each resample, shape (B, N).
        prior: A prior that was part of the loss; every resample keeps it.
    """
    extra = None if prior is None else prior.equations(optimum)
    each = MomentObjective(moments).image_equations(optimum)
    hessians = (weights @ each.hessian.flatten(1)).view(-1, optimum.size, optimum.size)
    steps = -_solve(*_with_prior(hessians, weights @ each.gradient, extra, None))
    lifted = _lifted_gram(moments)
    size = lifted.shape[-1]
    last = torch.zeros_like(steps)
    for chunk in torch.arange(len(weights)).split(max(1, _CHUNK_ENTRIES // size**2)):
        gram = (weights[chunk] @ lifted.flatten(1)).view(-1, size, size)
        for _ in range(_NEWTON_STEPS):
            features, jacobian = _lifted_parameters(optimum, steps[chunk])
            weighted = gram @ jacobian
            gradient = (features[:, None, :] @ weighted)[:, 0]
            hessian = jacobian.transpose(1, 2) @ weighted
            equations = _with_prior(hessian, gradient, extra, steps[chunk])
            last[chunk] = -_solve(*equations)
            steps[chunk] = _compose(steps[chunk], last[chunk], optimum.twist_size)
    spread = steps.square().mean(dim=0).sqrt().clamp(min=1e-300)
    return Bootstrap(steps, float((last / spread).norm(dim=1).median()))


def _with_prior(
    hessian: Float[Tensor, "B P P"],
    gradient: Float[Tensor, "B P"],
    prior: NormalEquations | None,
    steps: Float[Tensor, "B P"] | None,
) -> tuple[Float[Tensor, "B P P"], Float[Tensor, "B P"]]:
    """Add a prior to normal equations at steps (B, P) from the optimum; None: at the optimum.

    `prior` holds the prior's own equations at the optimum.
    """
    if prior is None:
        return hessian, gradient
    slope = prior.gradient if steps is None else prior.gradient + steps @ prior.hessian
    return hessian + prior.hessian, gradient + slope


def _lifted_gram(moments: ImageMoments) -> Float[Tensor, "N F F"]:
    """Return each image's moments of the features Phi, shape (N, F, F) with F = 9C + 4."""
    num_images, size = moments.gram.shape[:2]
    columns = (size - 1) // 3
    normal = moments.normal_tool
    # An image's loss is p' G p, and p is linear in Phi: its entry 3j + a is the sum over k of
    # m_k Phi_(j, a, k), its last entry is m.t + e.
    by_row = (moments.gram[:, :, :-1, None] * normal[:, None, None, :]).flatten(2)
    ends = torch.cat([normal, moments.offset_tool[:, None]], dim=1)
    right = torch.cat([by_row, moments.gram[:, :, -1:] * ends[:, None, :]], dim=2)
    top = (right[:, :-1, None, :] * normal[:, None, :, None]).flatten(1, 2)
    lifted = torch.cat([top, right[:, -1:, :] * ends[:, :, None]], dim=1)
    assert lifted.shape == (num_images, 9 * columns + 4, 9 * columns + 4)
    return lifted


def _lifted_parameters(
    optimum: Parameters, steps: Float[Tensor, "B P"]
) -> tuple[Float[Tensor, "B F"], Float[Tensor, "B F P"]]:
    """Return the features Phi (B, F) of resamples, and their derivative (B, F, P)."""
    transform = optimum.tool_from_camera.expand(len(steps), 4, 4)
    if optimum.hand_eye_is_free:
        transform = transform @ se3.exp(steps[:, :6])
    coefficients = optimum.coefficients + steps[:, optimum.twist_size :]
    rotation = transform[:, :3, :3]
    b = torch.cat([torch.ones_like(coefficients[:, :1]), -coefficients], dim=1)
    # Feature (j, a, k) is b_j R_ka: the rotation is transposed.
    turned = rotation.transpose(1, 2).flatten(1)
    features = torch.cat(
        [
            (b[:, :, None] * turned[:, None, :]).flatten(1),
            transform[:, :3, 3],
            torch.ones_like(b[:, :1]),
        ],
        dim=1,
    )
    jacobian = features.new_zeros(*features.shape, optimum.size)
    num_products = 9 * b.shape[1]
    if optimum.hand_eye_is_free:
        for axis in range(3):
            generator = torch.zeros(3, 3, dtype=torch.float64)
            generator[(axis + 2) % 3, (axis + 1) % 3] = 1.0
            generator[(axis + 1) % 3, (axis + 2) % 3] = -1.0
            change = (rotation @ generator).transpose(1, 2).flatten(1)
            jacobian[:, :num_products, 3 + axis] = (b[:, :, None] * change[:, None, :]).flatten(1)
        jacobian[:, num_products : num_products + 3, :3] = rotation
    for k in range(coefficients.shape[1]):
        jacobian[:, 9 * (k + 1) : 9 * (k + 2), optimum.twist_size + k] = -turned
    return features, jacobian


def _compose(
    steps: Float[Tensor, "B P"], moves: Float[Tensor, "B P"], twist_size: int
) -> Float[Tensor, "B P"]:
    """Return the single steps (B, P) that equal a step followed by a further move."""
    if not twist_size:
        return steps + moves
    twist = se3.log(se3.exp(steps[:, :6]) @ se3.exp(moves[:, :6]))
    return torch.cat([twist, steps[:, 6:] + moves[:, 6:]], dim=1)


def _solve(hessian: Float[Tensor, "B P P"], gradient: Float[Tensor, "B P"]) -> Float[Tensor, "B P"]:
    """Solve batched normal equations, each unknown scaled to its own curvature."""
    scale = hessian.diagonal(dim1=1, dim2=2).clamp(min=1e-300).sqrt()
    scaled = hessian / scale[:, :, None] / scale[:, None, :]
    scaled = scaled + _RIDGE * torch.eye(scaled.shape[-1], dtype=scaled.dtype)
    return torch.linalg.solve(scaled, (gradient / scale)[:, :, None])[:, :, 0] / scale
