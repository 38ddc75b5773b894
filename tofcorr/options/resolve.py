"""From whatever names a configuration to checked options: shipped names, files, dotted changes."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from tofcorr.errors import ConfigError
from tofcorr.options.base import Options, OptionsT, one_line
from tofcorr.options.yaml_files import parse_yaml, read_yaml


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


Container = dict[str, Any] | list[Any]


def apply_changes(
    values: Mapping[str, Any], changes: Iterable[str], defaults: Callable[[], Mapping[str, Any]]
) -> dict[str, Any]:
    """Return `values` with single entries replaced; whether a key exists is not checked here.

    Args:
        values: Keys and values, as YAML gives them; not modified.
        changes: `dotted.key=value`; the value is YAML, and an entry of a list is named by its
            index from zero.
        defaults: Gives all keys with their defaults; asked when a change leads into a mapping or
            list that `values` leaves out.

    Raises:
        ConfigError: A change is not of this form, or leads into a value that has no entries.
    """
    changed: dict[str, Any] = _copied(values)
    for change in changes:
        key, equals, text = change.partition("=")
        if not equals or not all(key.split(".")):
            raise ConfigError(
                f"'{one_line(change)}': expected KEY=VALUE with a dotted key, "
                "such as solver.max_iterations=30."
            )
        _set(changed, key, parse_yaml(text, f"'{one_line(change)}'"), defaults)
    return changed


def _set(
    values: Container, key: str, value: object, defaults: Callable[[], Mapping[str, Any]]
) -> None:
    *parents, last = key.split(".")
    here = values
    for depth, name in enumerate(parents):
        above = ".".join(parents[:depth])
        entry = _key(here, name, above)
        child = here[entry] if isinstance(here, list) else here.get(entry)
        if child is None:
            child = _default(defaults, parents[: depth + 1])
            here[entry] = child
        if not isinstance(child, dict | list):
            raise ConfigError(
                one_line(f"'{key}': '{'.'.join(parents[: depth + 1])}' is the value {child!r}, ")
                + "which has no entries."
            )
        here = child
    here[_key(here, last, ".".join(parents))] = value


def _key(container: Container, name: str, above: str) -> Any:  # noqa: ANN401 - a key or an index
    """Return the key of a mapping, or the index of a list."""
    if isinstance(container, dict):
        return name
    if not name.isdecimal() or int(name) >= len(container):
        span = f"0 to {len(container) - 1}" if container else "none: it is empty"
        raise ConfigError(
            f"'{one_line(f'{above}.{name}')}': '{above}' is a list; its entries are {span}."
        )
    return int(name)


def _default(defaults: Callable[[], Mapping[str, Any]], path: list[str]) -> Container:
    """Return the default at `path`, or an empty mapping where there is none."""
    here: Any = defaults()
    for name in path:
        if isinstance(here, list):
            here = here[int(name)] if name.isdecimal() and int(name) < len(here) else None
        else:
            here = here.get(name) if isinstance(here, Mapping) else None
    return {} if here is None else _copied(here)


def _copied(value: Any) -> Any:  # noqa: ANN401 - any YAML value
    if isinstance(value, Mapping):
        return {key: _copied(one) for key, one in value.items()}
    return [_copied(one) for one in value] if isinstance(value, list | tuple) else value


def configs_folder() -> Path:
    """Return the folder of the shipped configurations.

    An installed package holds it as `tofcorr/configs`; in a checkout it stands beside `tofcorr`.
    """
    package = Path(__file__).resolve().parents[1]
    inside = package / "configs"
    return inside if inside.is_dir() else package.parent / "configs"


def shipped_folders() -> list[str]:
    """Return the folders of shipped configurations: `train`, `evaluate`, ..."""
    return sorted(path.name for path in configs_folder().glob("*") if path.is_dir())


def shipped_names(folder: str) -> list[str]:
    """Return the names of the configurations shipped for `folder`, such as `ea` for `train`."""
    return sorted(path.stem for path in (configs_folder() / folder).glob("*.yaml"))


def is_shipped_name(text: str, folder: str) -> bool:
    """Say whether `text` names a configuration shipped for `folder`."""
    return bool(folder) and text in shipped_names(folder)


def shipped_file(text: str, folder: str) -> Path:
    """Return the file that `text` means: a shipped name first, otherwise a path.

    A name comes first so that a folder `ea` of results does not hide the configuration `ea`;
    `./ea` means the file.

    Args:
        text: What the user gave.
        folder: Folder below `configs/` where its names stand; empty: only paths.

    Raises:
        ConfigError: It is neither a name nor a file.
    """
    if is_shipped_name(text, folder):
        return configs_folder() / folder / f"{text}.yaml"
    path = Path(text)
    if not folder or _exists(path):
        return path
    names = shipped_names(folder)
    close = get_close_matches(path.stem, names, n=1)
    hint = f" Did you mean '{close[0]}'?" if close else ""
    raise ConfigError(
        f"{text}: neither a file nor a configuration shipped for '{folder}'.{hint} "
        f"Shipped: {', '.join(names)}."
    )


def _exists(path: Path) -> bool:
    try:
        return path.exists()
    except OSError:  # A name too long for any file.
        return False
