"""What a model needs from the recordings, checked before anything is read."""

from tofcorr.error_terms.domain import Domain
from tofcorr.error_terms.model import ErrorModel, ErrorModelOptions
from tofcorr.errors import CalibrationDataError
from tofcorr.estimation.design import Design
from tofcorr.pixels.dataset import Dataset


def build_model(
    dataset: Dataset, options: ErrorModelOptions, domain: Domain
) -> tuple[ErrorModel, Design]:
    """Build an error model with zero coefficients for the data set's camera, and its design.

    Raises:
        CalibrationDataError: The model needs what a recording lacks: amplitudes, the modulation
            frequency, a column of frames.csv; or its amplitudes are all the same.
    """
    refuse_missing_inputs(dataset, options)
    _refuse_one_amplitude(dataset, options, domain)
    error = ErrorModel(options, domain)
    return error, Design(error, domain, dataset.ray_directions())


_DEPTH_ALONE = (
    "`tofcorr train --config e0` needs depth alone, and so do evaluate and select with "
    "`--set 'models=[{config: e0}]'`"
)


def refuse_missing_inputs(dataset: Dataset, options: ErrorModelOptions) -> None:
    """Refuse a recording that lacks an input of a term.

    Raises:
        CalibrationDataError: An input is missing; the message names the file and the term.
    """
    for term in options.terms:
        for name in term.needs:
            try:
                dataset.require(name, f"the term {term.kind}")
            except CalibrationDataError as error:
                raise CalibrationDataError(
                    f"{error} Record it, or choose models without that term: {_DEPTH_ALONE}."
                ) from None


def _refuse_one_amplitude(dataset: Dataset, options: ErrorModelOptions, domain: Domain) -> None:
    """Refuse a term of the amplitude where that never changes: no coefficient is determined."""
    found = domain.amplitude
    if found is None or found.low < found.high:
        return
    for term in options.terms:
        if "amplitude" in term.needs:
            raise CalibrationDataError(
                f"{dataset.first.path}: amplitude.npy holds {found.low:g} in every pixel used, so "
                f"it was not measured, and the term {term.kind} needs it. Remove the file and "
                f"choose models without that term: {_DEPTH_ALONE}."
            )
