"""The whole error model: one constant and its terms."""

import copy
from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from pydantic import model_validator
from torch import Tensor, nn
from torch.nn.functional import interpolate

from tofcorr.error_terms.base import (
    EVERYTHING,
    ConditionTerm,
    DescribedModule,
    Domain,
    PixelMap,
    PixelTerm,
    SignalTerm,
    Term,
)
from tofcorr.error_terms.registry import TermOptions, build_term
from tofcorr.error_terms.residual import ResidualNetwork
from tofcorr.errors import CalibrationDataError
from tofcorr.options import Options


class ErrorModelOptions(Options):
    """The terms of an error model; without terms the constant remains.

    Attributes:
        terms: In the order in which they are reported.
    """

    terms: tuple[TermOptions, ...] = ()

    @model_validator(mode="after")
    def _one_map(self) -> "ErrorModelOptions":
        if len(maps := [term.kind for term in self.terms if not term.has_columns]) > 1:
            raise ValueError(f"the term {maps[0]} may be given only once")
        return self

    def with_columns(self) -> "ErrorModelOptions":
        """Return the terms that the moments estimate: all but a map of the pixels."""
        return ErrorModelOptions(terms=tuple(term for term in self.terms if term.has_columns))

    def with_found(self, option: str, values: Iterable[object]) -> "ErrorModelOptions":
        """Return the terms with values found in the data where this option says `auto`, in turn."""
        found = iter(values)
        terms = [
            one.model_copy(update={option: next(found)}) if one.is_open(option) else one
            for one in self.terms
        ]
        return self.model_copy(update={"terms": tuple(terms)})

    def same_coefficients(self, other: "ErrorModelOptions") -> bool:
        """Whether both models have the same terms, apart from what a fit finds in the data."""
        return [t.structure() for t in self.terms] == [t.structure() for t in other.terms]


class Pixels(NamedTuple):
    """Pixels of any frames.

    Attributes:
        radial_distance: Measured, shape (M,), metres.
        amplitude: Shape (M,); any values if the model does not read it.
        rows: Shape (M,), pixels.
        columns: Shape (M,), pixels.
        conditions: Of their frames, shape (M, C).
    """

    radial_distance: Tensor
    amplitude: Tensor
    rows: Tensor
    columns: Tensor
    conditions: Tensor


class ErrorModel(DescribedModule):
    r"""Predicted error of a pixel: one constant and the sum of the terms.

    .. math:: E(v) = e_0 + \sum_s S_s(D_v, I_v) + \sum_p P_p(r_v, c_v) + \sum_h H_h + F_v + R_v

    with signal, pixel and condition terms, and, where the model has them, the fixed pattern F and
    the residual network R. Sign: error = measured - true, in metres along the ray.

    Args:
        options: The terms, in order.
        domain: Image size and ranges, which scale the variables.

    Shape:
        - Input: `(..., H, W)`, radial distances in metres and amplitudes in the camera's units;
          `(..., C)`, the frames' conditions, or None for the mean conditions.
        - Output: `(..., H, W)`, predicted errors in metres.
    """

    def __init__(self, options: ErrorModelOptions, domain: Domain) -> None:
        super().__init__()
        self.constant = nn.Parameter(torch.zeros((), dtype=torch.float64))
        built = [build_term(term, domain) for term in options.terms]
        self.signal_terms, self.pixel_terms, self.condition_terms = (
            nn.ModuleList([term for term in built if isinstance(term, base)])
            for base in (SignalTerm, PixelTerm, ConditionTerm)
        )
        maps = [term for term in built if isinstance(term, PixelMap)]
        self.fixed_pattern: PixelMap | None = maps[0] if maps else None
        self.residual: ResidualNetwork | None = None
        self.height: int = domain.height
        self.width: int = domain.width
        # Where row and column 0 lie in the image of the terms, and the size of a pixel there.
        self.origin: tuple[float, ...] = (0, 0)
        self.step: tuple[float, ...] = (1, 1)
        self.is_part: bool = False

    def part(
        self, top: int, left: int, height: int, width: int, size: tuple[int, int]
    ) -> "ErrorModel":
        """Return the model of a part of the image; it shares the parameters with this one.

        Args:
            top: First row.
            left: First column.
            height: Number of rows.
            width: Number of columns.
            size: Rows and columns to which the part is resized, its outer edges kept. A fixed
                pattern is averaged over each new pixel.
        """
        part, steps = copy.copy(self), (height / size[0], width / size[1])
        part._modules = dict(self._modules)
        (part.height, part.width), part.is_part = size, True
        own = list(zip(self.origin, self.step, (top, left), steps, strict=True))
        # Pixel centres are integers, as in `CameraIntrinsics.resize`.
        part.origin = tuple(o + s * (first + (step - 1) / 2) for o, s, first, step in own)
        part.step = tuple(s * step for _, s, _, step in own)
        if self.fixed_pattern is not None:
            part.fixed_pattern = copy.copy(self.fixed_pattern)
            offset = self.fixed_pattern.offset[top : top + height, left : left + width]
            if size != (height, width):
                offset = interpolate(offset[None, None], size, mode="area")[0, 0]
            part.fixed_pattern._buffers = {"offset": offset}
        return part

    def description(self) -> dict[str, Any]:
        """Return image size, terms and residual network."""
        return {
            "image size": [self.height, self.width],
            "terms": [term.description() for term in self._terms_and_map()],
            "residual network": None if self.residual is None else self.residual.description(),
        }

    def set_options(self, options: ErrorModelOptions) -> None:
        """Replace the terms' options by others of the same functions, in any order."""
        remaining = list(options.terms)
        for term in self._terms_and_map():
            own = term.options.structure()
            term.options = next(one for one in remaining if one.structure() == own)
            remaining.remove(term.options)

    def _terms_and_map(self) -> list[Term | PixelMap]:
        return [*self.terms(), *([] if self.fixed_pattern is None else [self.fixed_pattern])]

    def needs_amplitude(self) -> bool:
        """Whether any term, or the residual network, reads the amplitude."""
        of_network = self.residual is not None and self.residual.uses_amplitude
        return of_network or any(bool(term.needs_amplitude) for term in self.signal_terms)

    def needs_normalised_amplitude(self) -> bool:
        """Whether any term is a function of the distance-normalised amplitude N = I D^2."""
        return any(bool(term.uses_normalised_amplitude) for term in self.signal_terms)

    def limits(self, domain: Domain) -> Domain:
        """Return the ranges inside which a pixel is valid, rounded outwards to float32.

        Every variable of the error is clamped to its range: beyond it the error at the range's edge
        is used. A variable that the error does not depend on has no limits.
        """
        read = {
            "radial_distance": True,
            "amplitude": self.needs_amplitude(),
            "normalised_amplitude": self.needs_normalised_amplitude(),
        }
        limits = {name: getattr(domain, name) if own else None for name, own in read.items()}
        return replace(domain, **{k: (one or EVERYTHING).outwards() for k, one in limits.items()})

    def symbols(self) -> list[str]:
        """The coefficients' names, in the order of `coefficient_vector`."""
        return ["c0", *(symbol for term in self.terms() for symbol in term.symbols)]

    def image_symbols(self) -> list[str]:
        """The names of the coefficients but those of condition terms; they come first."""
        of_frames = sum(len(term.symbols) for term in self.condition_terms)  # type: ignore[arg-type]
        symbols = self.symbols()
        return symbols[: len(symbols) - of_frames]

    def pixel_grid(self) -> tuple[Tensor, Tensor]:
        """Return rows (H, 1) and columns (1, W) in pixels."""
        axes = zip(self.origin, self.step, (self.height, self.width), strict=True)
        rows, columns = (o + step * torch.arange(size).to(self.constant) for o, step, size in axes)
        return rows[:, None], columns[None, :]

    def pixel_error(self) -> Tensor:
        """Return the sum of constant, pixel terms and fixed pattern, shape (H, W), metres."""
        rows, columns = torch.broadcast_tensors(*self.pixel_grid())
        error = self.constant.expand(self.height, self.width)
        for term in self.pixel_terms:
            error = error + term(rows, columns)
        if self.fixed_pattern is not None:
            error = error + self.fixed_pattern.offset
        return error

    def signal_error(
        self, distance: Tensor, amplitude: Tensor, normalised_range: Iterable[Any] = EVERYTHING
    ) -> Tensor:
        """Return the sum of the signal terms, shape (...), metres.

        Args:
            distance: Radial distances inside their range, shape (...), metres.
            amplitude: Amplitudes inside their range, same shape.
            normalised_range: Both ends of the range of N = I D^2, to which N is clamped here.
        """
        error = torch.zeros_like(distance)
        for term in self.signal_terms:
            strength = amplitude
            if term.uses_normalised_amplitude:
                square = distance.square()
                strength = (strength * square).clamp(*normalised_range) / square
            error = error + term(distance, strength)
        return error

    def condition_error(self, conditions: Tensor) -> Tensor:
        """Return the sum of the condition terms of frames (..., C), shape (...), metres."""
        error = torch.zeros_like(conditions[..., 0])
        for term in self.condition_terms:
            error = error + term(conditions)
        return error

    def forward(
        self, radial_distance: Tensor, amplitude: Tensor, conditions: Tensor | None = None
    ) -> Tensor:
        """Return the predicted error, shape (..., H, W), metres."""
        error = self.pixel_error() + self.signal_error(radial_distance, amplitude)
        if conditions is not None:
            error = error + self.condition_error(conditions)[..., None, None]
        if self.residual is not None:
            error = error + self.residual(radial_distance, amplitude, *self.pixel_grid())
        return error.expand(radial_distance.shape)

    def columns_at(self, pixels: Pixels) -> Tensor:
        """Return the functions that the coefficients multiply at some pixels, shape (K, M)."""
        ones = torch.ones_like(pixels.radial_distance)[None]
        signal = [t.basis(pixels.radial_distance, pixels.amplitude) for t in self.signal_terms]  # type: ignore[operator]
        place = [t.basis(pixels.rows, pixels.columns) for t in self.pixel_terms]  # type: ignore[operator]
        frame = [t.basis(pixels.conditions) for t in self.condition_terms]  # type: ignore[operator]
        return torch.cat([ones, *signal, *place, *frame])

    def pattern_at(self, pixels: Pixels) -> Tensor:
        """Return the fixed pattern at some pixels, shape (M,), metres."""
        if self.fixed_pattern is None:
            return torch.zeros_like(pixels.radial_distance)
        return self.fixed_pattern.offset[pixels.rows.long(), pixels.columns.long()]

    @torch.no_grad()
    def error_at(self, pixels: Pixels) -> Tensor:
        """Return the predicted error at some pixels, shape (M,), metres along the ray."""
        error = self.coefficient_vector() @ self.columns_at(pixels) + self.pattern_at(pixels)
        return error if self.residual is None else error + self.residual(*pixels[:4])

    def coefficient_vector(self) -> Tensor:
        """Return constant and coefficients as one vector, detached, float64."""
        return nn.utils.parameters_to_vector(self._ordered()).detach().clone()

    def set_coefficient_vector(self, values: Tensor) -> None:
        """Set constant and coefficients from one vector; inverse of `coefficient_vector`."""
        with torch.no_grad():
            for own, given in zip(
                self._ordered(), values.split([p.numel() for p in self._ordered()]), strict=True
            ):
                own.copy_(given.view_as(own))

    def paper_coefficients(self) -> dict[str, dict[str, float]]:
        """Return the coefficients in the paper's symbols, on unscaled variables.

        One group a letter (`distance`, `pixel`, `intensity`), since c0 names two things in the
        paper. Only the sum of the constants c0, p0 and i0 is identifiable: it is given as c0 of
        the distance.
        """
        found = self.paper_values()
        return {g: {name: own for name, (own, _) in named.items()} for g, named in found.items()}

    def paper_values(self) -> dict[str, dict[str, tuple[float, str]]]:
        """Return the same, each coefficient with its unit."""
        constant = float(self.constant.detach())
        groups: dict[str, dict[str, tuple[float, str]]] = {"distance": {"c0": (0.0, "m")}}
        for term in self.terms():
            values, remaining = term.paper_coefficients()
            constant += remaining
            groups.setdefault(term.group, {}).update(values)
        groups["distance"]["c0"] = constant, "m"
        return groups

    def set_paper_coefficients(self, groups: dict[str, dict[str, float]]) -> None:
        """Set coefficients in the paper's symbols; inverse of `paper_coefficients`.

        Raises:
            KeyError: A coefficient of a term is missing.
        """
        constant = groups["distance"]["c0"]
        for term in self.terms():
            constant += term.set_paper_coefficients(groups[term.group])
        self.constant.data.fill_(constant)

    def terms(self) -> list[Term]:
        """Return the terms that have coefficients, in the order of `coefficient_vector`."""
        return [*self.signal_terms, *self.pixel_terms, *self.condition_terms]  # type: ignore[list-item]

    def penalised(self) -> Iterator[tuple[Term, int]]:
        """Yield the terms that have a roughness, and where their coefficients begin."""
        start = 1
        for term in self.terms():
            if len(term.roughness()):
                yield term, start
            start += len(term.symbols)

    def _ordered(self) -> list[nn.Parameter]:
        return [self.constant, *(term.coefficients for term in self.terms())]


def columns_on(options: ErrorModelOptions, domain: Domain, other: Domain) -> Tensor:
    """Return a model's functions on one domain as combinations of those on another, shape (C, C).

    With functions f = S g the coefficients change by the transpose: b . f = (S^T b) . g. Term by
    term, the combinations are those of least squares over random points of both domains, so that
    nothing has to be known of a kind of term.

    Args:
        options: The terms.
        domain: Ranges that scale the functions f.
        other: Ranges that scale the functions g, of the same image size and frequency.

    Returns:
        The matrix S, in the order of `ErrorModel.coefficient_vector`, float64.

    Raises:
        CalibrationDataError: A term has other functions there, as splines have whose knots differ.
    """
    own, its, every = ErrorModel(options, domain), ErrorModel(options, other), domain.joined(other)
    # A condition is clamped to its range: functions of it are compared where both ranges hold.
    each = domain.conditions, other.conditions
    shared = {
        name: (max(one[name][0] for one in each), min(one[name][1] for one in each), both[2])
        for name, both in every.conditions.items()
    }
    *signal, conditions = replace(every, conditions=shared).probes()
    size = own.coefficient_vector().numel()
    found, start = torch.eye(size, dtype=torch.float64), 1
    for one, another in zip(own.terms(), its.terms(), strict=True):
        place = slice(start, start := start + len(one.symbols))
        if isinstance(one, PixelTerm):
            continue
        given = (conditions,) if isinstance(one, ConditionTerm) else signal
        with torch.no_grad():
            f, g = (term.basis(*given) for term in (one, another))  # type: ignore[operator]
        columns = torch.cat([torch.ones_like(g[:1]), g]).T
        solution = torch.linalg.lstsq(columns, f.T).solution.T
        if not torch.allclose(solution @ columns.T, f, rtol=_SAME, atol=_SAME):
            kind = one.options.kind  # type: ignore[attr-defined]
            advice = "Choose a polynomial, or train on all recordings together."
            raise CalibrationDataError(f"{kind}: its functions depend on the range. {advice}")
        found[place, 0], found[place, place] = solution[:, 0], solution[:, 1:]
    return found


# Largest deviation of a function, relative to its size and absolute, that counts as rounding.
_SAME = 1e-9
