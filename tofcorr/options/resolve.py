"""From whatever names a configuration to checked options."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from tofcorr.errors import ConfigError
from tofcorr.options.base import Options, OptionsT
from tofcorr.options.changes import apply_changes
from tofcorr.options.messages import one_line
from tofcorr.options.shipped import shipped_file
from tofcorr.options.yaml_files import read_yaml


def load_options(cls: type[OptionsT], path: Path | str) -> OptionsT:
    """Read `path` as YAML and check it against the options class `cls`.

    Raises:
        ConfigError: The file cannot be read, or does not fit `cls`.
    """
    return cls.from_mapping(_read_mapping(Path(path)), str(path))


def resolve_options(
    cls: type[OptionsT],
    config: str | Path | Mapping[str, Any] | Options,
    changes: Sequence[str] = (),
) -> OptionsT:
    """Return the options that `config` names, with single values changed.

    Args:
        cls: The options class wanted.
        config: The name of a shipped configuration (`"ea"`) or a file, if text; a file, if a
            `Path`; otherwise keys and values, or options of `cls`.
        changes: `dotted.key=value`, such as `solver.max_iterations=30` or
            `model.terms.0.degree=4`; values are YAML.

    Raises:
        ConfigError: No such configuration, an unknown key, or a value that is not allowed.
    """
    if isinstance(config, cls) and not changes:
        return config
    values, where = _values_of(cls, config)
    if changes:
        where += " with " + one_line(", ".join(changes))
        values = apply_changes(values, changes, lambda: _with_defaults(cls, values))
    return cls.from_mapping(values, where)


def _values_of(
    cls: type[Options], config: str | Path | Mapping[str, Any] | Options
) -> tuple[Mapping[str, Any], str]:
    """Return keys and values, and what to call their source in an error message."""
    if isinstance(config, Options):
        if not isinstance(config, cls):
            raise ConfigError(f"expected {cls.__name__}, got {type(config).__name__}.")
        return config.to_mapping(), cls.__name__
    if isinstance(config, Mapping):
        return config, "the configuration"
    if isinstance(config, str):
        config = shipped_file(config, cls.config_folder)
    return _read_mapping(config), str(config)


def _read_mapping(path: Path) -> Mapping[str, Any]:
    values = read_yaml(path)
    if not isinstance(values, Mapping):
        raise ConfigError(f"{path}: expected keys and values, got {type(values).__name__}.")
    return values


def _with_defaults(cls: type[Options], values: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return all keys with their values or defaults; only `values` if they do not fit `cls`."""
    try:
        return cls.from_mapping(values, "").to_mapping()
    except ConfigError:
        return values
