"""Every kind of error term, registered once.

A new kind is a file in this folder and one line here: its module, its options class and its class.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple, Union

from pydantic import Field

from tofcorr.error_terms.base import BaseTermOptions, Domain, PixelMap, Term

_KINDS = (
    ("polynomials", "DistancePolynomialOptions", "SignalPolynomial"),
    ("splines", "DistanceSplineOptions", "SignalSpline"),
    ("splines", "LookupTableOptions", "SignalSpline"),
    ("periodic", "PeriodicOptions", "Periodic"),
    ("polynomials", "AmplitudePolynomialOptions", "SignalPolynomial"),
    ("splines", "IncidentLightOptions", "SignalSpline"),
    ("splines", "TensorSplineOptions", "TensorSpline"),
    ("polynomials", "PixelPolynomialOptions", "PixelPolynomial"),
    ("fixed_pattern", "FixedPatternOptions", "FixedPattern"),
    ("condition_terms", "IntegrationTimeOptions", "ConditionPolynomial"),
    ("condition_terms", "RoomTemperatureOptions", "ConditionPolynomial"),
    ("condition_terms", "WarmUpOptions", "WarmUp"),
)
# Not a term of the list `terms`: it is trained on top of them and has a key of its own in YAML.
_RESIDUAL = ("residual", "ResidualNetworkOptions", "ResidualNetwork")


class Kind(NamedTuple):
    """One kind of term: what describes it, and what computes it."""

    options: type[Any]
    term: type[Any]


def _load(module: str, options: str, term: str) -> Kind:
    found = import_module(f"tofcorr.error_terms.{module}")
    return Kind(getattr(found, options), getattr(found, term))


TERMS: dict[str, Kind] = {
    kind.options.model_fields["kind"].default: kind for kind in (_load(*line) for line in _KINDS)
}
"""Every kind of term by its name in YAML."""

RESIDUAL_NETWORK: Kind = _load(*_RESIDUAL)
"""The residual network."""

if TYPE_CHECKING:
    TermOptions = BaseTermOptions
else:
    TermOptions = Annotated[
        Union[tuple(kind.options for kind in TERMS.values())],  # noqa: UP007 - built from a tuple
        Field(discriminator="kind"),
    ]
    """The options of any kind of term; `kind` says which."""


def build_term(options: BaseTermOptions, domain: Domain) -> Term | PixelMap:
    """Build a term, untrained, scaled to the calibrated ranges.

    Raises:
        CalibrationDataError: The domain lacks what the term needs.
    """
    return TERMS[options.kind].term(options, domain)
