"""Every kind of error term, registered once.

A new kind is a file in this folder and one line here: its module, its options class and its class.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Annotated, Any, Union

from pydantic import Field

from tofcorr.error_terms.base import BaseTermOptions, Domain, PixelMap, Term

_KINDS = (
    ("signal_terms", "DistancePolynomialOptions", "SignalPolynomial"),
    ("splines", "DistanceSplineOptions", "SignalSpline"),
    ("splines", "LookupTableOptions", "SignalSpline"),
    ("signal_terms", "PeriodicOptions", "Periodic"),
    ("signal_terms", "AmplitudePolynomialOptions", "SignalPolynomial"),
    ("splines", "IncidentLightOptions", "SignalSpline"),
    ("splines", "TensorSplineOptions", "TensorSpline"),
    ("pixel_terms", "PixelPolynomialOptions", "PixelPolynomial"),
    ("pixel_terms", "FixedPatternOptions", "FixedPattern"),
    ("condition_terms", "IntegrationTimeOptions", "ConditionPolynomial"),
    ("condition_terms", "RoomTemperatureOptions", "ConditionPolynomial"),
    ("condition_terms", "AmbientLightOptions", "ConditionPolynomial"),
    ("condition_terms", "WarmUpOptions", "WarmUp"),
)


def _class(module: str, name: str) -> type[Any]:
    return getattr(import_module(f"tofcorr.error_terms.{module}"), name)


_TERM_OF = {_class(module, options): _class(module, term) for module, options, term in _KINDS}

TERMS: dict[str, type[BaseTermOptions]] = {
    options.model_fields["kind"].default: options for options in _TERM_OF
}
"""The options of every kind of term by its name in YAML."""

if TYPE_CHECKING:
    TermOptions = BaseTermOptions
else:
    TermOptions = Annotated[
        Union[tuple(_TERM_OF)],  # noqa: UP007 - built from a tuple
        Field(discriminator="kind"),
    ]
    """The options of any kind of term; `kind` says which."""


def build_term(options: BaseTermOptions, domain: Domain) -> Term | PixelMap:
    """Build a term, untrained, scaled to the calibrated ranges.

    Raises:
        CalibrationDataError: The domain lacks what the term needs.
    """
    return _TERM_OF[type(options)](options, domain)
