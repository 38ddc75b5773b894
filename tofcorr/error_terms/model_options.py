"""Which terms an error model has."""

from pydantic import model_validator

from tofcorr.error_terms.registry import TermOptions
from tofcorr.error_terms.term_options import BaseTermOptions
from tofcorr.options import Options


class ErrorModelOptions(Options):
    """The terms of an error model; without terms the constant remains.

    Attributes:
        terms: In the order in which they are reported.
    """

    terms: tuple[TermOptions, ...] = ()

    @model_validator(mode="after")
    def _one_map(self) -> "ErrorModelOptions":
        maps = [term.kind for term in self.terms if not term.has_columns]
        if len(maps) > 1:
            raise ValueError(f"the term {maps[0]} may be given only once")
        return self

    @property
    def pixel_map(self) -> BaseTermOptions | None:
        """The options of the term that is a map of the pixels; None if there is none."""
        return next((term for term in self.terms if not term.has_columns), None)

    def with_columns(self) -> "ErrorModelOptions":
        """Return the terms that the moments estimate: all but a map of the pixels."""
        return ErrorModelOptions(terms=tuple(term for term in self.terms if term.has_columns))

    def without(self, missing: str) -> "ErrorModelOptions":
        """Return the terms that do not need `missing`, such as `amplitude`."""
        return ErrorModelOptions(terms=tuple(t for t in self.terms if missing not in t.needs))

    def same_coefficients(self, other: "ErrorModelOptions") -> bool:
        """Whether both models have the same terms, apart from what a fit finds in the data."""
        return [t.structure() for t in self.terms] == [t.structure() for t in other.terms]
