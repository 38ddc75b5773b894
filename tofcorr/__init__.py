"""Time-of-flight depth correction, hand-eye calibration and diagnosis of the sim-to-real gap.

The public names stand in `__init__.pyi`. They load on first use, so that `import tofcorr` and
`tofcorr --help` cost nothing.
"""

import re
from importlib import import_module
from pathlib import Path

_STUB = Path(__file__).with_suffix(".pyi").read_text(encoding="utf-8")
_PUBLIC = {
    name: module for module, name in re.findall(r"^from (\S+) import (\w+)", _STUB, re.MULTILINE)
}
__all__ = sorted(_PUBLIC)  # noqa: PLE0605  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> object:
    """Import a public name when it is first asked for."""
    if name not in _PUBLIC:
        raise AttributeError(f"module 'tofcorr' has no attribute {name!r}")
    return getattr(import_module(_PUBLIC[name]), name)


def __dir__() -> list[str]:
    """List the public names."""
    return __all__
