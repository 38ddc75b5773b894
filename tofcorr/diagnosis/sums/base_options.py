"""The base model's terms made definite: refused, left out, or their open options determined."""

import numpy as np

from tofcorr.data.recording import Recording
from tofcorr.error_terms.fixed_pattern import FixedPatternOptions
from tofcorr.error_terms.model_options import ErrorModelOptions
from tofcorr.errors import CalibrationDataError
from tofcorr.fit.fitting import fit
from tofcorr.fit.inputs import refuse_missing_inputs
from tofcorr.fit.options import FitOptions
from tofcorr.pixels.dataset import Dataset
from tofcorr.pixels.domain import covered_domain


def definite_base(
    recording: Recording, base: ErrorModelOptions
) -> tuple[ErrorModelOptions, list[str]]:
    """Return the terms that the recording can support, with every `auto` replaced, and warnings.

    Amplitude terms are left out, with a warning, where no amplitude was recorded. What else says
    `auto`, a smoothness or a time constant, is determined by the fit of `tofcorr train`. The spread
    of a fixed pattern stays open: it is estimated from the residual of the base fit.

    Args:
        recording: The recording under diagnosis.
        base: The terms asked for.

    Raises:
        CalibrationDataError: The recording lacks what another term needs; names the term.
    """
    base, warnings = _without_amplitude_terms(recording, base)
    dataset = Dataset((recording,))
    refuse_missing_inputs(dataset, base)
    columns = base.model_copy(update={"terms": tuple(t for t in base.terms if t.has_columns)})
    if not any(term.is_open(option) for term in columns.terms for option in term.found_in_data):
        return base, warnings
    frames = np.arange(dataset.num_frames)
    found = fit(dataset, frames, FitOptions(model=columns), covered_domain(dataset, frames))
    definite = iter(found.options.terms)
    terms = tuple(next(definite) if term.has_columns else term for term in base.terms)
    return base.model_copy(update={"terms": terms}), warnings


def _without_amplitude_terms(
    recording: Recording, base: ErrorModelOptions
) -> tuple[ErrorModelOptions, list[str]]:
    if recording.amplitude is not None:
        return base, []
    kept = tuple(term for term in base.terms if not term.needs_amplitude)
    if len(kept) == len(base.terms):
        return base, []
    dropped = ", ".join(term.kind for term in base.terms if term.needs_amplitude)
    warning = (
        f"{recording.path}: amplitude.npy is missing; the base model has no amplitude term "
        f"({dropped} left out). An error that depends on the amplitude cannot be named. What could "
        "be one, by distance, incidence, exposure and place in the image, is not counted for other "
        "effects; on a patterned target it also raises the noise floor, an upper bound therefore."
    )
    return base.model_copy(update={"terms": kept}), [warning]


def supported_base(
    recording: Recording, base: ErrorModelOptions
) -> tuple[ErrorModelOptions, list[str]]:
    """Return the terms whose inputs a recording has, and the kinds of the others."""
    dataset, kept, lacking = Dataset((recording,)), [], []
    for term in base.terms:
        try:
            refuse_missing_inputs(dataset, base.model_copy(update={"terms": (term,)}))
        except CalibrationDataError:
            lacking.append(term.kind)
        else:
            kept.append(term)
    return base.model_copy(update={"terms": tuple(kept)}), lacking


def map_term(base: ErrorModelOptions) -> FixedPatternOptions | None:
    """Return the term with one value a pixel instead of columns; None: there is none."""
    return next((term for term in base.terms if isinstance(term, FixedPatternOptions)), None)
