"""Options that come from YAML: frozen, checked, and refused with a hint when a key is unknown."""

import reprlib
from collections.abc import Mapping
from difflib import get_close_matches
from pathlib import Path
from typing import Any, Self, TypeVar

import yaml
from pydantic import BaseModel, ConfigDict, ValidationError
from pydantic_core import ErrorDetails

from tofcorr.errors import ConfigError

# PyYAML lets more than its own error through: a tag such as !!bool before a value that it does
# not fit ends in a KeyError, IndexError or AttributeError.
_NOT_YAML = (yaml.YAMLError, ValueError, LookupError, AttributeError, RecursionError)


class Options(BaseModel):
    """Base of every options class: immutable, and deaf to no key."""

    model_config = ConfigDict(frozen=True, extra="forbid", arbitrary_types_allowed=False)

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
            raise ConfigError(_in_words(error, cls, where)) from None

    def to_mapping(self) -> dict[str, Any]:
        """Return plain values, ready for YAML or JSON."""
        return self.model_dump(mode="json")


OptionsT = TypeVar("OptionsT", bound=Options)


def read_yaml(path: Path) -> Any:  # noqa: ANN401 - YAML may hold anything
    """Read one YAML file.

    Raises:
        ConfigError: The file is missing, unreadable or not YAML.
    """
    try:
        return yaml.safe_load(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ConfigError(f"{path}: there is no such file.") from None
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read as text ({error}).") from None
    except _NOT_YAML as error:
        first_line = " ".join(str(error).split())
        raise ConfigError(f"{path}: not valid YAML: {first_line}") from None


def load_options(cls: type[OptionsT], path: Path | str) -> OptionsT:
    """Read `path` as YAML and check it against the options class `cls`.

    Raises:
        ConfigError: The file cannot be read, or does not fit `cls`.
    """
    path = Path(path)
    values = read_yaml(path)
    if not isinstance(values, Mapping):
        raise ConfigError(f"{path}: expected keys and values, got {type(values).__name__}.")
    return cls.from_mapping(values, str(path))


def dump_yaml(values: Mapping[str, Any]) -> str:
    """Return `values` as YAML text, keys in the order given."""
    return yaml.safe_dump(dict(values), sort_keys=False, allow_unicode=True, width=100)


def _in_words(error: ValidationError, cls: type[BaseModel], where: str) -> str:
    return f"{where}: " + "; ".join(_one(detail, cls) for detail in error.errors()[:5])


def _one(detail: ErrorDetails, cls: type[BaseModel]) -> str:
    path = ".".join(str(part) for part in detail["loc"]) or "the file"
    if detail["type"] == "extra_forbidden":
        close = get_close_matches(str(detail["loc"][-1]), _known_keys(cls), n=1)
        hint = f" Did you mean '{close[0]}'?" if close else ""
        return f"'{path}' is not a known key.{hint}"
    if detail["type"] == "missing":
        return f"'{path}' is missing."
    message = detail["msg"].removeprefix("Value error, ")
    return f"'{path}': {message} (got {_shown(detail['input'])})."


def _shown(value: object) -> str:
    """Return `value` as text of bounded length, however deep or long a file made it."""
    try:
        return reprlib.repr(value)
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
    return [found for part in nested for found in _option_classes(part)]
