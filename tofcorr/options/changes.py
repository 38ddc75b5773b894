"""Single options changed by their dotted name: `solver.max_iterations=30`."""

from collections.abc import Callable, Iterable, Mapping
from typing import Any

from tofcorr.errors import ConfigError
from tofcorr.options.messages import one_line
from tofcorr.options.yaml_files import parse_yaml

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
