r"""Per-image moments of the point-to-plane residual, the loss that they give, and priors.

Image i holds the Gram matrix :math:`G_i = \sum_v w_v\, q_v q_v^T` of its pixels' columns

.. math:: q_v = (D, f_1 s_1, \dots, f_K s_K) \otimes (x, y, z), \; 1

so that for coefficients :math:`b = (1, -\beta)`, rotation R, translation t, and the target plane
(m, e) in the tool frame, the squared residuals of the image sum to :math:`p_i^T G_i p_i` with
:math:`p_i = (b \otimes R^T m_i, \; m_i \cdot t + e_i)`. Their sum is the loss, in square metres
(times the unit of the weights). A prior is one more sum of squares:

.. math:: \sum_v w_v r_v^2 + s^2 \lVert L\,\delta - \mu \rVert^2

with :math:`\delta` the step from a guess, and :math:`s^2` the effective variance of a residual.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Float
from torch import Tensor

from tofcorr.estimation.linear import NormalEquations
from tofcorr.geometry import se3

_PER_IMAGE = ("gram", "normal_tool", "offset_tool", "count")


@dataclass(frozen=True)
class ImageMoments:
    """The moments of each image, and the plane it looked at.

    Attributes:
        gram: Moment matrices, shape (N, S, S) with S = 3C + 1; entry 3j + a belongs to column j and
            ray axis a, the last to the constant 1.
        normal_tool: The target's unit normal in the tool frame, shape (N, 3).
        offset_tool: The target's offset in the tool frame, shape (N,), metres.
        count: Pixels used, shape (N,).
        symbols: The names of the coefficients, C - 1 of them.
    """

    gram: Float[Tensor, "N S S"]
    normal_tool: Float[Tensor, "N 3"]
    offset_tool: Float[Tensor, "N"]
    count: Float[Tensor, "N"]
    symbols: list[str]

    @property
    def planes(self) -> Float[Tensor, "N 4"]:
        """Each image's plane in the tool frame, normal and offset."""
        return torch.cat([self.normal_tool, self.offset_tool[:, None]], dim=1)

    def images(self, chosen: Tensor | Sequence[int]) -> "ImageMoments":
        """Return the moments of some images, by index or by mask (N,)."""
        pick = torch.as_tensor(chosen, device=self.gram.device)
        return replace(self, **{name: getattr(self, name)[pick] for name in _PER_IMAGE})

    def weighted(self, weights: Float[Tensor, "N"]) -> "ImageMoments":
        """Return the moments with each image counted `weights` (N,) times."""
        return replace(self, gram=self.gram * weights[:, None, None], count=self.count * weights)

    def columns(self, symbols: Sequence[str]) -> "ImageMoments":
        """Return the moments of the model that has only the coefficients named."""
        chosen = [0, *(1 + self.symbols.index(symbol) for symbol in symbols)]
        entries = [3 * j + a for j in chosen for a in range(3)] + [self.gram.shape[-1] - 1]
        return replace(self, gram=self.gram[:, entries][:, :, entries], symbols=list(symbols))

    def with_conditions(
        self, functions: Float[Tensor, "N K"], symbols: Sequence[str]
    ) -> "ImageMoments":
        """Return the moments with further columns that are the same for all pixels of an image.

        Such a column is the constant's times a number an image, so it needs no pass over pixels.

        Args:
            functions: The number of each image and column, shape (N, K).
            symbols: The columns' names.
        """
        constant = 3 * (1 + self.symbols.index("c0"))
        factor = functions.to(self.gram)[:, :, None, None]

        def grown(gram: Float[Tensor, "N A B"]) -> Float[Tensor, "N _ B"]:
            further = (factor * gram[:, None, constant : constant + 3]).flatten(1, 2)
            return torch.cat([gram[:, :-1], further, gram[:, -1:]], dim=1)

        gram = grown(grown(self.gram).mT)
        return replace(self, gram=gram, symbols=[*self.symbols, *symbols])


def concatenate(parts: Sequence[ImageMoments]) -> ImageMoments:
    """Join the moments of several passes over the same design."""
    joined = {name: torch.cat([getattr(one, name) for one in parts]) for name in _PER_IMAGE}
    return replace(parts[0], **joined)


HAND_EYE_SYMBOLS = ["t_x", "t_y", "t_z", "w_x", "w_y", "w_z"]
"""Names of the twist's entries: translation in metres, then rotation in radians, camera axes."""
LEAST_RESIDUAL = 1e-5
"""Least standard deviation of a residual, metres. On data without noise the loss is only rounding,
and would look like information. A hundredth of a millimetre is far below any camera's noise."""


@dataclass(frozen=True)
class Parameters:
    """A point in the space of the unknowns: the hand-eye's twist, then the coefficients.

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
        return self.twist_size + len(self.coefficients)

    @property
    def twist_size(self) -> int:
        """6 if the hand-eye is estimated, else 0."""
        return 6 if self.hand_eye_is_free else 0

    def moved(self, step: Float[Tensor, "P"]) -> "Parameters":
        """Return T exp(step[:6]) and coefficients + step[6:]; differentiable in the step (P,)."""
        transform = self.tool_from_camera
        if self.hand_eye_is_free:
            transform = transform @ se3.exp(step[:6])
        moved = self.coefficients + step[self.twist_size : self.size]
        return replace(self, tool_from_camera=transform, coefficients=moved)

    def step_to(self, other: "Parameters") -> Float[Tensor, "P"]:
        """Return the step that `moved` takes from here to other parameters; differentiable."""
        change = other.coefficients - self.coefficients
        if not self.hand_eye_is_free:
            return change
        between = se3.inverse(self.tool_from_camera) @ other.tool_from_camera
        return torch.cat([se3.log(between), change])

    def detached(self) -> "Parameters":
        """Return the parameters without a gradient."""
        transform, coefficients = self.tool_from_camera.detach(), self.coefficients.detach()
        return replace(self, tool_from_camera=transform, coefficients=coefficients)

    def _factors(self) -> Float[Tensor, "C"]:
        """Return b, which the columns are multiplied with: of the distance and of each term."""
        return torch.nn.functional.pad(-self.coefficients, (1, 0), value=1.0)

    def by_entries(self) -> Float[Tensor, "4 S"]:
        """Return the matrix A whose rows a plane (m_i, e_i) sums to its residual vector."""
        rows = _entries(self._factors(), self.tool_from_camera[:3])
        return torch.cat([rows, torch.eye(rows.shape[1]).to(rows)[-1:]])

    def slope(self) -> Float[Tensor, "4 S P"]:
        """Return the derivative of that matrix by a step of `moved`."""
        rows, num = self.tool_from_camera[:3], len(self.coefficients)
        turned = rows @ se3.GENERATORS[: self.twist_size].to(rows)
        still = torch.nn.functional.pad(rows[:, :3], (0, 1)).expand(num, 3, 4)
        each = -torch.eye(num + 1)[1:].to(rows)
        slopes = torch.cat([_entries(self._factors(), turned), _entries(each, still)])
        return torch.nn.functional.pad(slopes, (0, 0, 0, 1)).movedim(0, -1)


def _entries(
    factors: Float[Tensor, "*B C"], rows: Float[Tensor, "*T 3 4"]
) -> Float[Tensor, "*T 3 S"]:
    """Return the first three rows of A, which are linear in b and in those of a transform."""
    normals = (factors[..., None, :, None] * rows[..., :, None, :3]).flatten(-2)
    return torch.cat([normals, rows[..., 3:]], dim=-1)


class MomentObjective:
    """The loss from per-image moments: microseconds, whatever the number of pixels.

    A residual vector is linear in the image's plane, p_i = A^T h_i with h_i = (m_i, e_i) and one
    matrix A (4, S) of the unknowns. So the loss is a^T Q a, with a the entries of A and
    Q = sum_i h_i h_i^T outer G_i: after one sum over the images, it takes the same time for any
    number of them.

    Args:
        moments: Moments of the images to fit.
        prior: A prior that is added; None: there is none.
    """

    def __init__(self, moments: ImageMoments, prior: "Prior | None" = None) -> None:
        self.moments, self.prior = moments, prior

    @cached_property
    def _joint(self) -> Float[Tensor, "E E"]:
        """The matrix Q, E = 4 S."""
        planes, size = self.moments.planes, self.moments.gram.shape[-1]
        pairs = (planes[:, :, None] * planes[:, None, :]).flatten(1)
        by_entry = (pairs.T @ self.moments.gram.flatten(1)).view(4, 4, size, size)
        return by_entry.transpose(1, 2).reshape(4 * size, 4 * size)

    def image_losses(self, parameters: Parameters) -> Float[Tensor, "N"]:
        """Return the sum of squared residuals of each image, shape (N,)."""
        p = residual_vectors(self.moments, parameters)
        return (p * (self.moments.gram @ p[:, :, None])[:, :, 0]).sum(dim=1)

    def loss(self, parameters: Parameters) -> Float[Tensor, ""]:
        """Return the loss, differentiable."""
        images = self.image_losses(parameters).sum()
        return images if self.prior is None else images + self.prior.equations(parameters).loss

    def image_equations(
        self, parameters: Parameters, further: Float[Tensor, "N S F"] | None = None
    ) -> NormalEquations:
        """Return the normal equations of each image: (N,), (N, P) and (N, P, P).

        Args:
            parameters: Where.
            further: Derivatives of the residual vectors by further unknowns, shape (N, S, F); they
                come after the others.
        """
        p = residual_vectors(self.moments, parameters)
        jacobian = torch.tensordot(self.moments.planes, parameters.slope(), dims=1)
        if further is not None:
            jacobian = torch.cat([jacobian, further], dim=2)
        weighted = self.moments.gram @ jacobian
        gradient = (p[:, None, :] @ weighted)[:, 0]
        return NormalEquations(self.image_losses(parameters), gradient, jacobian.mT @ weighted)

    def normal_equations(self, parameters: Parameters) -> NormalEquations:
        """Return loss, gradient and Gauss-Newton Hessian, summed over the images."""
        jacobian = parameters.slope().flatten(0, 1)
        weighted = self._joint @ jacobian
        # Each image's loss by itself has lost fewer digits than a @ Q @ a.
        gradient = parameters.by_entries().flatten() @ weighted
        loss = self.image_losses(parameters).sum()
        images = NormalEquations(loss, gradient, jacobian.mT @ weighted)
        return images if self.prior is None else images.plus(self.prior.equations(parameters))


def residual_vectors(moments: ImageMoments, parameters: Parameters) -> Float[Tensor, "N S"]:
    """Return p_i = (b outer R^T m_i, m_i . t + e_i), shape (N, S), S = 3C + 1."""
    return moments.planes @ parameters.by_entries()


@dataclass(frozen=True)
class Prior:
    """A Gaussian prior around a guess, along some directions.

    Attributes:
        centre: The guess.
        factor: The rows L, in standard deviations per metre or radian, shape (F, P).
        variance: The effective variance of a residual, which puts both parts on one scale, in
            the unit of the loss.
        names: The direction of each row, in words.
        target: Prior mean of L times the step from the guess, shape (F,), or one number.
    """

    centre: Parameters
    factor: Float[Tensor, "F P"]
    variance: float
    names: list[str]
    target: Float[Tensor, "F"] | float = 0.0

    def deviation(self, parameters: Parameters) -> Float[Tensor, "F"]:
        """Return L times the step from the guess, less its target, shape (F,); differentiable."""
        return self.factor @ self.centre.step_to(parameters) - self.target

    def _jacobian(self, parameters: Parameters) -> Float[Tensor, "F P"]:
        """Return the derivative of the deviation by a step, shape (F, P)."""
        by_twist = self.factor[:, : parameters.twist_size]
        if not bool(by_twist.any()):  # Linear in the coefficients.
            return self.factor
        slope = se3.log_slope(self.centre.step_to(parameters)[: parameters.twist_size])
        return torch.cat([by_twist @ slope, self.factor[:, parameters.twist_size :]], dim=1)

    @property
    def scores(self) -> Float[Tensor, "P F"]:
        """How much each row's own error of one standard deviation changes the gradient."""
        return self.variance * self.factor.T

    def rescaled(self, variance: float) -> "Prior":
        """Return the same prior on the scale of another effective variance of a residual."""
        grown = math.sqrt(self.variance / variance)
        factor, target = self.factor * grown, self.target * grown
        return replace(self, factor=factor, variance=variance, target=target)

    def joined(self, other: "Prior") -> "Prior":
        """Return this prior together with one that is about coefficients alone."""
        other = other.rescaled(self.variance)
        own = other.factor[:, self.centre.twist_size :]
        apart = own @ (other.centre.coefficients - self.centre.coefficients)
        here = self.factor.new_zeros(len(self.factor)) + self.target
        return replace(
            self,
            factor=torch.cat([self.factor, other.factor]),
            names=[*self.names, *other.names],
            target=torch.cat([here, other.target + apart]),
        )

    def equations(self, parameters: Parameters) -> NormalEquations:
        """Return the prior's part of the normal equations at `parameters`."""
        deviation, jacobian = self.deviation(parameters), self._jacobian(parameters)
        parts = deviation.square().sum(), deviation @ jacobian, jacobian.T @ jacobian
        return NormalEquations(*(self.variance * part for part in parts))
