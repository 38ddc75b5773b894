"""What is fuzzed: one way to mutate an input and to read it, and what to compare it with."""

import random
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml


class SilentlyDifferentError(Exception):
    """A mutated input was accepted, and means something else than what it says."""


@dataclass(frozen=True)
class Target:
    """One format, or one way in.

    Attributes:
        name: For the summary.
        share: Its share of all inputs, relative to the others'.
        attempt: Draws a mutated input, writes it into a folder, and reads it. It raises a
            `TofcorrError` if the input is refused, and `SilentlyDifferentError`.
    """

    name: str
    share: float
    attempt: Callable[[random.Random, Path], object]


def require_equal(found: Any, stated: Any, where: str) -> None:  # noqa: ANN401 - any value
    """Refuse a value that was read and is not what the file states.

    Keys that one of both lacks are not compared: unknown keys of a recording are ignored, and what
    a file leaves out has a default.
    """
    if isinstance(found, dict) and isinstance(stated, dict):
        for key in found.keys() & stated.keys():
            require_equal(found[key], stated[key], f"{where}.{key}")
        return
    if stated is None:
        return  # Null means the default.
    if isinstance(found, list | tuple) and isinstance(stated, list | tuple):
        if len(found) != len(stated):
            raise SilentlyDifferentError(f"{where}: {len(stated)} entries became {len(found)}")
        for place, (one, other) in enumerate(zip(found, stated, strict=True)):
            require_equal(one, other, f"{where}.{place}")
        return
    if _number(found) is not None and _number(stated) is not None:
        same = _number(found) == _number(stated) or str(found) == str(stated)
    else:
        same = found == stated or str(found) == str(stated)
    if not same:
        raise SilentlyDifferentError(f"{where}: {stated!r} became {found!r}")


def stated(text: str | bytes) -> Any:  # noqa: ANN401 - YAML may hold anything
    """Return what PyYAML's slow parser reads, or None where it refuses what libyaml allows."""
    try:
        return yaml.safe_load(text)
    except (yaml.YAMLError, ValueError):
        return None


def require_same_array(found: np.ndarray, stated: np.ndarray, where: str) -> None:
    """Refuse an array that was read and is not what another reader finds."""
    if found.shape != stated.shape or not np.array_equal(found, stated, equal_nan=True):
        raise SilentlyDifferentError(f"{where}: other numbers than another reader finds")


def _number(value: Any) -> float | None:  # noqa: ANN401 - any value
    try:
        return float(value)
    except (TypeError, ValueError, OverflowError):
        return None
