"""The base of every options class, and what pydantic found wrong with one, in a sentence."""

import reprlib
from collections.abc import Mapping
from difflib import get_close_matches
from typing import Any, ClassVar, Self, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError

from tofcorr.errors import ConfigError


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


_LONGEST = 240
"""Longest piece of a file's text that a message repeats, characters. Set by hand: three lines of a
terminal."""


def one_line(text: str, longest: int = _LONGEST) -> str:
    """Return text of a file for a message: in one line, and of bounded length.

    Args:
        text: What the file holds, or what a library says of it.
        longest: Characters that are kept.
    """
    flat = "".join(one if one.isprintable() else " " for one in text)
    return flat if len(flat) <= longest else flat[: longest - 3] + "..."


def in_words(error: ValidationError, cls: type[BaseModel], where: str) -> str:
    """Return the faults of `error` in words.

    Args:
        error: Raised by the validation of `cls`.
        cls: The options class; its keys serve as hints.
        where: What to call the source of the values, usually the file.
    """
    # More than five would hide the first, which often causes the others.
    return f"{where}: " + "; ".join(_one(detail, cls) for detail in error.errors()[:5])


def _one(detail: Mapping[str, Any], cls: type[BaseModel]) -> str:
    path = one_line(".".join(str(part) for part in detail["loc"]) or "the file")
    if detail["type"] == "extra_forbidden":
        close = get_close_matches(str(detail["loc"][-1]), _known_keys(cls), n=1)
        hint = f" Did you mean '{close[0]}'?" if close else ""
        return f"'{path}' is not a known key.{hint}"
    if detail["type"] == "missing":
        return f"'{path}' is missing."
    message = one_line(detail["msg"].removeprefix("Value error, "), 3 * _LONGEST)
    if not detail["loc"]:  # Of all entries together; they would not fit.
        return f"{message}."
    return f"'{path}': {message} (got {_shown(detail['input'])})."


def _shown(value: object) -> str:
    """Return `value` as text of bounded length, however deep or long a file made it."""
    try:
        return one_line(reprlib.repr(value))
    except ValueError:  # Python does not print integers of more than 4300 digits.
        return "a very long number"


def _known_keys(cls: type[BaseModel], seen: set[type] | None = None) -> list[str]:
    """Collect the keys of `cls` and of every options class nested in it."""
    seen = set() if seen is None else seen
    if cls in seen:
        return []
    seen.add(cls)
    keys = list(cls.model_fields)
    for field in cls.model_fields.values():
        for nested in _option_classes(field.annotation):
            keys += _known_keys(nested, seen)
    return keys


def _option_classes(annotation: Any) -> list[type[BaseModel]]:  # noqa: ANN401 - any annotation
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    nested = getattr(annotation, "__args__", ())
    return [found for argument in nested for found in _option_classes(argument)]
