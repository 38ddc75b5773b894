"""The base of every options class."""

from collections.abc import Mapping
from typing import Any, ClassVar, Self, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError

from tofcorr.errors import ConfigError
from tofcorr.options.messages import in_words


class Options(BaseModel):
    """Base of every options class: immutable; an unknown key is an error.

    Attributes:
        config_folder: Folder below `configs/` that holds the shipped files of this class; empty
            where none is shipped. A property of the class, not a key of the file.
    """

    model_config = ConfigDict(
        frozen=True, defer_build=True, extra="forbid", arbitrary_types_allowed=False
    )

    config_folder: ClassVar[str] = ""

    @classmethod
    def from_mapping(cls, values: Mapping[str, Any], where: str) -> Self:
        """Check `values` and build the options.

        Args:
            values: Keys and values, as YAML gives them.
            where: What to call the source in an error message, usually the file.

        Raises:
            ConfigError: A key is unknown or missing, or a value is not allowed.
        """
        try:
            return cls.model_validate(values)
        except ValidationError as error:
            raise ConfigError(in_words(error, cls, where)) from None

    def to_mapping(self) -> dict[str, Any]:
        """Return plain values, ready for YAML or JSON."""
        return self.model_dump(mode="json")


OptionsT = TypeVar("OptionsT", bound=Options)
