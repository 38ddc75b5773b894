"""Real recordings with a form of an effect added."""

from collections.abc import Iterator
from pathlib import Path


def generate_real(seed: int, out: Path) -> Iterator[str]:
    """Add tier K to a folder; yield each recording's name."""
    raise NotImplementedError(f"no real recordings are made yet (seed {seed}, {out})")
