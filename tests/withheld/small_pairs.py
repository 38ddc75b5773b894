"""Pairs of twelve frames for tests."""

from typing import Any

import numpy as np

from benchmarks.withheld.generator.pair_cases import PairCase
from benchmarks.withheld.generator.pairs import Pair, record_pair
from benchmarks.withheld.generator.poses import Design

SMALL = Design(frames=12, repeats=2)


def a_pair(seed: int = 4, **case: Any) -> Pair:
    """Record a small pair of the kind `ideal`, with changes of its case."""
    return record_pair(np.random.default_rng(seed), PairCase("ideal", design=SMALL, **case))
