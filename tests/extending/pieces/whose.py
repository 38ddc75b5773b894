# ruff: noqa: T201 - its output is looked at
"""Which tofcorr it is that runs."""

from pathlib import Path

import tofcorr

print(Path(tofcorr.__file__).parents[1])
