"""Effects from the list in a configuration."""

from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from typing import Any

from tofcorr.errors import ConfigError
from tofcorr.simulation.effects import CATALOGUE
from tofcorr.simulation.hooks import Effect

_KNOWN = ", ".join(sorted(CATALOGUE))


def build_effects(
    entries: Sequence[Mapping[str, Any]], where: str = "effects"
) -> tuple[Effect, ...]:
    """Build the effects that options list.

    Args:
        entries: One mapping per effect: `name`, and its parameters.
        where: What to call the list in an error message.

    Raises:
        ConfigError: An entry lacks its name, its name is unknown, or a parameter is wrong.
    """
    return tuple(
        _build_effect(dict(entry), f"{where}[{place}]") for place, entry in enumerate(entries)
    )


def _build_effect(entry: dict[str, Any], where: str) -> Effect:
    name = entry.pop("name", None)
    if name is None:
        raise ConfigError(f"{where}: 'name' is missing; known effects: {_KNOWN}.")
    if name not in CATALOGUE:
        close = get_close_matches(str(name), CATALOGUE, n=1)
        hint = f"Did you mean '{close[0]}'?" if close else f"Known effects: {_KNOWN}."
        raise ConfigError(f"{where}: there is no effect '{name}'. {hint}")
    return CATALOGUE[name].from_mapping(entry, f"{where} ({name})")
