"""The ranges from which every design is drawn; `ranges.yaml` states them."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import yaml

from benchmarks.renewed.geometry import Random


@dataclass(frozen=True)
class Range:
    """Numbers between two limits, evenly or evenly in their logarithm."""

    low: float
    high: float
    log: bool = False

    def draw(self, rng: Random) -> float:
        """One number."""
        if self.log:
            return float(np.exp(rng.uniform(np.log(self.low), np.log(self.high))))
        return float(rng.uniform(self.low, self.high))


def draw(name: str, rng: Random) -> Any:  # noqa: ANN401 - of any kind
    """One number of a range, or one of the choices, which have these probabilities."""
    given = RANGES[name]
    if isinstance(given, Range):
        return given.draw(rng)
    weights = np.array(list(given.values()))
    return list(given)[rng.choice(len(given), p=weights / weights.sum())]


@contextmanager
def drawn_from(**others: Any) -> Iterator[None]:  # noqa: ANN401 - ranges of any kind
    """Draw worlds from other ranges while this lasts."""
    with patch.dict(RANGES, others):
        yield


def _read(name: str, given: Any) -> Any:  # noqa: ANN401 - a number, a range or choices
    if isinstance(given, dict) and "from" in given:
        return Range(given["from"], given["to"], given.get("log", False))
    number = {"images": int, "frequencies_mhz": float}.get(name)
    if number:
        return {tuple(map(number, str(key).split())): share for key, share in given.items()}
    return given


RANGES, PLAIN = (
    {name: _read(name, given) for name, given in part.items()}
    for part in yaml.safe_load(Path(__file__).with_suffix(".yaml").read_text()).values()
)
"""What is drawn; and what differs from it in a plain laboratory."""
