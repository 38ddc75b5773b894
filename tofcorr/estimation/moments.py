r"""Per-image moments of the point-to-plane residual: all that a squared loss needs of the pixels.

Image i holds the Gram matrix :math:`G_i = \sum_v w_v\, q_v q_v^T` of its pixels' columns

.. math:: q_v = (D, f_1 s_1, \dots, f_K s_K) \otimes (x, y, z), \; 1

so that for coefficients :math:`b = (1, -\beta)`, rotation R, translation t, and the target plane
(m, e) in the tool frame, the squared residuals of the image sum to :math:`p_i^T G_i p_i` with
:math:`p_i = (b \otimes R^T m_i, \; m_i \cdot t + e_i)`.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

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
    def num_images(self) -> int:
        """How many images there are."""
        return len(self.gram)

    @property
    def num_coefficients(self) -> int:
        """Coefficients of the error model."""
        return len(self.symbols)

    @property
    def planes(self) -> Float[Tensor, "N 4"]:
        """Each image's plane in the tool frame, normal and offset."""
        return torch.cat([self.normal_tool, self.offset_tool[:, None]], dim=1)

    def _each(self, change: Callable[[Tensor], Tensor]) -> "ImageMoments":
        return replace(self, **{name: change(getattr(self, name)) for name in _PER_IMAGE})

    def images(self, chosen: Tensor | Sequence[int]) -> "ImageMoments":
        """Return the moments of some images, by index or by mask (N,)."""
        pick = torch.as_tensor(chosen, device=self.gram.device)
        return self._each(lambda part: part[pick])

    def to(self, device: torch.device | str) -> "ImageMoments":
        """Return the moments on a device."""
        return self._each(lambda part: part.to(device))

    def weighted(self, weights: Float[Tensor, "N"]) -> "ImageMoments":
        """Return the moments with each image counted `weights` (N,) times, as a bootstrap does."""
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
    """Join the moments of several passes over the same design.

    Raises:
        ValueError: There is nothing to join, or the designs differ.
    """
    if not parts:
        raise ValueError("There are no moments to join: no frame was read.")
    if any(part.symbols != parts[0].symbols for part in parts):
        raise ValueError("Moments of different error models cannot be joined.")
    joined = {name: torch.cat([getattr(one, name) for one in parts]) for name in _PER_IMAGE}
    return replace(parts[0], **joined)


def stack(parts: Iterable[ImageMoments], num_images: int) -> ImageMoments:
    """Join the moments of successive batches of one pass, `num_images` in all.

    Each is copied into memory allocated beforehand. Otherwise the small results would lie between
    the large temporary arrays of each batch, and the heap would grow with every batch.

    Raises:
        ValueError: There is nothing to join.
    """
    whole: ImageMoments | None = None
    filled = 0
    for part in parts:
        if whole is None:
            whole = part._each(lambda one: one.new_empty(num_images, *one.shape[1:]))
        for name in _PER_IMAGE:
            getattr(whole, name)[filled : filled + part.num_images] = getattr(part, name)
        filled += part.num_images
    if whole is None:
        raise ValueError("There are no moments to join: no frame was read.")
    return whole
