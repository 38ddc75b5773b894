"""The products of signal functions over a block of pixels, formed in memory already at hand."""

import threading
from itertools import pairwise
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from tofcorr.error_terms.bases import ScaledPolynomial
from tofcorr.estimation.design import Design, PairTable

# The number of the measured distance among the signal functions. Derived: that of `Design`.
_DISTANCE = 1


class SignalProducts:
    """Forms few products of signal functions, from which the sums of all others follow.

    Where a term holds an affine function of the distance, as every polynomial of it does, products
    with the distance are not formed: their sums are combinations of others. The memory of a thread
    is the same at every call, since new pages take longer to get: a result lasts until the next.

    Args:
        design: The columns.
        device: Where to compute.

    Attributes:
        number: How many products are formed.
        num_functions: How many of them, the first ones, are functions: products with 1.
        index: Which product formed f_a f_b is, shape (F, F); 0 if it is not formed.
    """

    def __init__(self, design: Design, device: str) -> None:
        self._design, self._device = design, device
        self._of_thread = threading.local()
        pairs = design.signal_pairs
        numbers = range(len(pairs.index))
        kept = [k for k in numbers if k != _DISTANCE or design.distance_as is None]
        self._skips_distance = len(kept) < len(numbers)
        self.num_functions = len(kept)
        formed = _formed(pairs, kept)
        self.number = len(formed)
        self._runs = _runs(formed[self.num_functions :], self.num_functions)
        place = {int(pairs.index[kept[a], kept[b]]): k for k, (a, b) in enumerate(formed)}
        self.index = torch.tensor([[place.get(k, 0) for k in row] for row in pairs.index.tolist()])

    def __call__(
        self,
        distance: Float[Tensor, "B h W"],
        amplitude: Float[Tensor, "B h W"],
        valid: Bool[Tensor, "B h W"] | None,
        weights: Float[Tensor, "B h W"] | None,
    ) -> Float[Tensor, "F B h W"]:
        """Return w f_a f_b of the products formed; zero where not valid.

        Args:
            distance: Radial distances, metres; any number where not valid.
            amplitude: The camera's units; any number where not valid.
            valid: Which pixels are used; None: all.
            weights: Of the pixels; None: 1 each.
        """
        room = self._room(distance.shape)
        self._write_functions(room, distance, amplitude, valid)
        for left, right, out in room.runs:
            torch.mul(left, right, out=out)
        if weights is not None:
            room.products.mul_(weights if valid is None else torch.where(valid, weights, 0.0))
        return room.products

    def with_distance(self, gram: Float[Tensor, "B S S"]) -> Float[Tensor, "B S S"]:
        """Fill in the rows and columns of the distance in Gram matrices (B, S, S), and return them.

        Like the distance, they are combinations of those of the constant and of its polynomial.
        """
        affine = self._design.distance_as
        if affine is None:
            return gram
        column = self._design.signal.tolist().index(affine.function)
        own, constant, other = (slice(3 * k, 3 * k + 3) for k in (0, 1, column))
        gram[:, own] = affine.centre * gram[:, constant] + affine.scale * gram[:, other]
        gram[:, :, own] = affine.centre * gram[:, :, constant] + affine.scale * gram[:, :, other]
        return gram

    def _write_functions(
        self,
        room: "_Room",
        distance: Float[Tensor, "B h W"],
        amplitude: Float[Tensor, "B h W"],
        valid: Bool[Tensor, "B h W"] | None,
    ) -> None:
        """Write all functions to their rows; zero where not valid."""
        one = room.rows[0]
        one.fill_(1.0) if valid is None else one.copy_(valid)
        place = 1
        if not self._skips_distance:
            _write_valid(distance, valid, room.rows[place])
            place += 1
        for term, form in zip(self._design.signal_terms, self._design.power_forms, strict=True):
            rows = slice(place, place + len(term.symbols))
            if form is None:
                with torch.no_grad():
                    basis = term.basis(_filled(distance, valid), _filled(amplitude, valid))
                torch.mul(basis, one, out=room.functions[rows])
            else:
                _write_powers(form, distance, amplitude, valid, room.rows[rows])
            place = rows.stop

    def _room(self, shape: torch.Size) -> "_Room":
        """Return the thread's memory, cut up for blocks of a shape."""
        rooms: dict[torch.Size, _Room] = getattr(self._of_thread, "rooms", {})
        if shape not in rooms:
            size = self.number * shape.numel()
            memory: Tensor | None = getattr(self._of_thread, "memory", None)
            if memory is None or len(memory) < size:
                memory = torch.empty(size, dtype=torch.float64, device=self._device)
                self._of_thread.memory, rooms = memory, {}
            products = memory[:size].view(self.number, *shape)
            functions = products[: self.num_functions]
            runs = [
                (
                    functions[run.left : run.left + run.lefts, None],
                    functions[run.right : run.right + run.rights],
                    products[run.first :][: run.lefts * run.rights].unflatten(0, (run.lefts, -1)),
                )
                for run in self._runs
            ]
            rooms[shape] = _Room(products, functions, list(functions), runs)
            self._of_thread.rooms = rooms
        return rooms[shape]


class _Room(NamedTuple):
    """Memory for the products of a block, and views of it, which take as long to get as to use.

    Attributes:
        products: All, the first of which are the functions themselves: their products with 1.
        functions: These.
        rows: Each function.
        runs: Of each run, the functions on its two sides, and where their products stand.
    """

    products: Float[Tensor, "F B h W"]
    functions: Float[Tensor, "K B h W"]
    rows: list[Tensor]
    runs: list[tuple[Tensor, Tensor, Tensor]]


class _Run(NamedTuple):
    """Products `first` and after, of each function on the left with every one on the right.

    On the left stand `lefts` functions from `left` on, on the right `rights` from `right` on.
    """

    first: int
    left: int
    lefts: int
    right: int
    rights: int


def _write_powers(
    form: ScaledPolynomial,
    distance: Float[Tensor, "B h W"],
    amplitude: Float[Tensor, "B h W"],
    valid: Bool[Tensor, "B h W"] | None,
    rows: list[Tensor],
) -> None:
    """Write u, u^2, ... of the scaled variable u to rows; zero where not valid."""
    scaled = rows[0]
    variable = distance if form.variable == "distance" else amplitude
    scaled.copy_(variable)
    if form.variable == "normalised_amplitude":
        scaled.mul_(distance).mul_(distance)
    # Scaled pixel by pixel: scaled in the sums, roundings of the factors made the solver search on.
    scaled.sub_(form.centre).mul_(1.0 / form.half_width)
    _write_valid(scaled, valid, scaled)
    for before, row in pairwise(rows):
        torch.mul(before, scaled, out=row)


def _write_valid(
    values: Float[Tensor, "B h W"], valid: Bool[Tensor, "B h W"] | None, row: Float[Tensor, "B h W"]
) -> None:
    """Write values to a row; zero where not valid, which zero times NaN would not be."""
    if valid is not None:
        torch.where(valid, values.to(row), row.new_zeros(()), out=row)
    elif row is not values:
        row.copy_(values)


def _filled(
    values: Float[Tensor, "B h W"], valid: Bool[Tensor, "B h W"] | None
) -> Float[Tensor, "B h W"]:
    """Return values in float64, and 1 where not valid."""
    values = values.double()
    return values if valid is None else torch.where(valid, values, 1.0)


def _formed(pairs: PairTable, kept: list[int]) -> list[tuple[int, int]]:
    """Return the kept functions, as products with 1, and a pair of them for each other product.

    A pair holds places in `kept`.
    """
    formed = [(0, k) for k in range(len(kept))]
    seen = {int(pairs.index[0, k]) for k in kept}
    for left in range(1, len(kept)):
        for right in range(left, len(kept)):
            product = int(pairs.index[kept[left], kept[right]])
            if product not in seen:
                seen.add(product)
                formed.append((left, right))
    return formed


def _runs(pairs: list[tuple[int, int]], start: int) -> list[_Run]:
    """Return the products in groups that one multiplication can form."""
    rows: list[_Run] = []
    for k, (a, b) in enumerate(pairs, start=start):
        if rows and (a, b) == (rows[-1].left, rows[-1].right + rows[-1].rights):
            rows[-1] = rows[-1]._replace(rights=rows[-1].rights + 1)
        else:
            rows.append(_Run(first=k, left=a, lefts=1, right=b, rights=1))
    runs: list[_Run] = []
    for row in rows:
        if runs and row[1:] == (runs[-1].left + runs[-1].lefts, 1, *runs[-1][3:]):
            runs[-1] = runs[-1]._replace(lefts=runs[-1].lefts + 1)
        else:
            runs.append(row)
    return runs
