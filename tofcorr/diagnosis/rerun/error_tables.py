"""The fitted error model as tables of the simulator, and what of it fits into no table."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Generic, Literal, NamedTuple, TypeVar

import numpy as np
import torch
from torch import Tensor

from tofcorr.diagnosis.sums.base_model import BaseModel
from tofcorr.diagnosis.sums.observations import Observations
from tofcorr.diagnosis.sums.study import Study
from tofcorr.error_terms.base import PixelTerm, SignalTerm, Term
from tofcorr.simulation.signal import (
    AmplitudeTable,
    CurveTable,
    LatticeTable,
    MeasuredErrorOptions,
    image_from_lattice,
)

# Knots of the distance curve: this many at least, and twice the coefficients of a term, so that a
# spline or a harmonic is resolved. Knots of the amplitude curve; points of the pixel lattice a
# side. Chosen; a test compares simulator and fit to 0.2 mm.
_LEAST_KNOTS = 13
_KNOTS_PER_COEFFICIENT = 2
_AMPLITUDE_KNOTS = 26
_LATTICE = 9
_LEAST_REACH = 1e-3
"""Least range of the knots over the amplitude, as a share of the smallest amplitude. Chosen: no
recording that changes at all has less."""

Variable = Literal["amplitude", "normalised_amplitude"]


TermT = TypeVar("TermT", bound=Term)


class _Fitted(NamedTuple, Generic[TermT]):
    """A term, the numbers of its coefficients in the model, and their values."""

    term: TermT
    numbers: Tensor
    values: Tensor


@dataclass(frozen=True, kw_only=True)
class ErrorTables:
    """A fitted error model, as far as the simulator has tables for it.

    Attributes:
        tables: The tables.
        beyond: Kinds of the terms that fit into no table.
        numbers: Numbers of their coefficients in the model, int64.
        coefficients: Of the whole model, shape (K,), metres.
    """

    tables: MeasuredErrorOptions
    beyond: tuple[str, ...]
    numbers: Tensor
    coefficients: Tensor

    def error_beyond(self, model: BaseModel, distance: Tensor) -> Tensor:
        """Return the error that the tables lack, at predicted distances (M,), metres."""
        columns = model.error_columns(distance)[:, self.numbers]
        return columns @ self.coefficients[self.numbers]


def error_tables(study: Study, coefficients: Tensor, already: MeasuredErrorOptions) -> ErrorTables:
    """Return the error model as tables, added to those that the simulator has.

    The simulator has one table of the distance, one of the image, and one of the amplitude or the
    normalised amplitude. Terms of conditions, of distance and amplitude together, or of a second
    amplitude variable fit into none.

    Args:
        study: The recording.
        coefficients: Of constant and terms, shape (K,), metres.
        already: Tables that the simulator has.
    """
    model = study.fit.model
    signal = _with_coefficients(model.signal_terms, coefficients, 1)
    after_signal = 1 + sum(len(each.numbers) for each in signal)
    pixel = _with_coefficients(model.pixel_terms, coefficients, after_signal)
    after_pixel = after_signal + sum(len(each.numbers) for each in pixel)
    beyond: list[_Fitted[Any]] = [
        *_with_coefficients(model.condition_terms, coefficients, after_pixel)
    ]
    by_distance, by_amplitude = [], []
    variable = None if already.amplitude is None else already.amplitude.variable
    for each in signal:
        if not each.term.needs_amplitude:
            by_distance.append(each)
            continue
        reads = _variable_of(each.term, study.observations)
        if reads is None or variable not in (None, reads):
            beyond.append(each)
        else:
            by_amplitude.append(each)
            variable = reads
    tables = {
        "constant_m": float(coefficients[0]) + already.constant_m,
        "distance": _distance_curve(study, by_distance, already.distance),
        "pixel": _pixel_lattice(study, pixel, already.pixel),
        "amplitude": _amplitude_curve(study, by_amplitude, variable, already.amplitude),
    }
    nothing = torch.zeros(0, dtype=torch.int64)
    return ErrorTables(
        tables=already.model_copy(update=tables),
        beyond=tuple(each.term.options.kind for each in beyond),
        numbers=torch.cat([nothing, *(each.numbers for each in beyond)]),
        coefficients=coefficients,
    )


def _with_coefficients(
    terms: Sequence[TermT], coefficients: Tensor, start: int
) -> list[_Fitted[TermT]]:
    """Return terms with their coefficients, of which the first has the number `start`."""
    found = []
    for term in terms:
        numbers = torch.arange(start, start + len(term.symbols))
        found.append(_Fitted(term, numbers, coefficients[numbers]))
        start += len(term.symbols)
    return found


def _variable_of(term: SignalTerm, observations: Observations) -> Variable | None:
    """Return the one variable that a term of the amplitude depends on; None: it depends on two."""
    if observations.amplitude is None:
        return None
    low, high = float(observations.measured.min()), float(observations.measured.max())
    dark, bright = float(observations.amplitude.min()), float(observations.amplitude.max())
    amplitude = torch.linspace(dark, bright, 9, dtype=torch.float64)
    near, far = torch.full_like(amplitude, low), torch.full_like(amplitude, high)
    if torch.equal(term.basis(near, amplitude), term.basis(far, amplitude)):
        return "amplitude"
    same_normalised = amplitude * (low / high) ** 2
    if torch.allclose(term.basis(near, amplitude), term.basis(far, same_normalised)):
        return "normalised_amplitude"
    return None


def _distance_curve(
    study: Study, terms: Sequence[_Fitted[SignalTerm]], already: CurveTable | None
) -> CurveTable:
    measured = study.observations.measured
    finest = max((len(each.numbers) for each in terms), default=0)
    count = max(_LEAST_KNOTS, _KNOTS_PER_COEFFICIENT * finest + 1)
    knots = np.linspace(float(measured.min()), float(measured.max()), count)
    values = np.zeros(count)
    at = torch.from_numpy(knots)
    for each in terms:
        values += (each.values @ each.term.basis(at, at).detach()).numpy()
    if already is not None:
        values = values + already.curve()(at).numpy()
    return CurveTable(knots=tuple(knots.tolist()), values_m=tuple(values.tolist()))


def _amplitude_curve(
    study: Study,
    terms: Sequence[_Fitted[SignalTerm]],
    variable: Variable | None,
    already: AmplitudeTable | None,
) -> AmplitudeTable | None:
    observations = study.observations
    if not terms or variable is None or observations.amplitude is None:
        return already
    values = observations.amplitude
    if variable == "normalised_amplitude":
        values = values * observations.measured**2
    # The curve bends most at dark pixels, so knots are dense there.
    low = float(values.min())
    # An amplitude that never changes still needs knots that do.
    reach = max(float(values.max()) - low, _LEAST_REACH * max(abs(low), 1.0))
    knots = low + reach * np.linspace(0.0, 1.0, _AMPLITUDE_KNOTS) ** 2
    at = torch.from_numpy(knots)
    curve = np.zeros_like(knots)
    for each in terms:
        curve = curve + (each.values @ each.term.basis(torch.ones_like(at), at).detach()).numpy()
    if already is not None:
        curve = curve + already.curve()(at).numpy()
    return AmplitudeTable(
        knots=tuple(knots.tolist()), values_m=tuple(curve.tolist()), variable=variable
    )


def _pixel_lattice(
    study: Study, terms: Sequence[_Fitted[PixelTerm]], already: LatticeTable | None
) -> LatticeTable:
    """Return the pixel terms on a lattice from corner to corner."""
    camera = study.observations.recording.camera
    rows = torch.linspace(0, camera.height - 1, _LATTICE).double()
    columns = torch.linspace(0, camera.width - 1, _LATTICE).double()
    at = torch.cartesian_prod(rows, columns)
    values = np.zeros((_LATTICE, _LATTICE))
    for each in terms:
        own = each.values @ each.term.basis(at[:, 0], at[:, 1]).detach()
        values += own.reshape(_LATTICE, _LATTICE).numpy()
    if already is not None:
        values = values + image_from_lattice(already.values_m, _LATTICE, _LATTICE).numpy()
    return LatticeTable(values_m=tuple(tuple(row) for row in values.tolist()))
