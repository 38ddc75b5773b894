"""What a kind of error term says of itself before it is built."""

import json
from typing import Any, ClassVar

from tofcorr.options import Options


class DescribedOptions(Options):
    """Options that decide which functions a module computes.

    Attributes:
        needs: What the module reads besides the measured distance: an attribute of a recording or
            of its frame table, such as `amplitude` or `integration_time`.
        found_in_data: The options that may say `auto`. A fit replaces them by what it found; they
            never change the set of functions.
    """

    needs: ClassVar[tuple[str, ...]] = ()
    found_in_data: ClassVar[tuple[str, ...]] = ()

    @property
    def needs_amplitude(self) -> bool:
        """Whether the module reads the amplitude."""
        return "amplitude" in self.needs

    def is_open(self, option: str) -> bool:
        """Whether this kind has an option of this name, and it says `auto`."""
        return option in self.found_in_data and getattr(self, option) == "auto"

    def structure(self) -> dict[str, Any]:
        """Return the options that fix the set of functions: all but those found in data."""
        values = self.to_mapping()
        return {key: values[key] for key in values if key not in self.found_in_data}


class BaseTermOptions(DescribedOptions):
    """Base of the options of every kind of error term.

    Attributes:
        kind: The term's name in YAML.
        grows_with: The option that only adds functions when it is raised, such as the degree of a
            polynomial; None if every option changes the functions. A larger term of such a family
            contains the smaller ones.
        has_columns: Whether the term is linear in a few coefficients, which the moments estimate.
    """

    kind: Any  # A literal in every kind.
    grows_with: ClassVar[str | None] = None
    has_columns: ClassVar[bool] = True

    def family(self) -> str:
        """Return what all terms of a nested family share, as text that can be compared."""
        values = self.to_mapping()
        shared = {key: values[key] for key in values if key != self.grows_with}
        return json.dumps(shared, sort_keys=True)

    def size_in_family(self) -> int:
        """Return the value of `grows_with`; 0 for a kind without families."""
        return 0 if self.grows_with is None else int(getattr(self, self.grows_with))
