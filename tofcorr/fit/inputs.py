"""What a model needs from the recordings, checked before anything is read."""

from tofcorr.error_terms.domain import Domain
from tofcorr.error_terms.model import ErrorModel
from tofcorr.error_terms.model_options import ErrorModelOptions
from tofcorr.errors import CalibrationDataError
from tofcorr.estimation.design import Design
from tofcorr.pixels.dataset import Dataset


def build_model(
    dataset: Dataset, options: ErrorModelOptions, domain: Domain
) -> tuple[ErrorModel, Design]:
    """Build an error model with zero coefficients for the data set's camera, and its design.

    Raises:
        CalibrationDataError: The model needs what a recording lacks: amplitudes, the modulation
            frequency, a column of frames.csv.
    """
    refuse_missing_inputs(dataset, options)
    error = ErrorModel(options, domain)
    return error, Design(error, domain, dataset.ray_directions())


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
                    f"{error} Record it, or choose a model without that term: `--config e0` needs "
                    "depth alone."
                ) from None
