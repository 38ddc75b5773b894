"""Options that come from YAML: frozen, checked, and refused with a hint when a key is unknown.

`Options` is the base of every options class. `resolve_options` builds one from whatever names a
configuration: a shipped name, a file, a mapping or options that exist already.
"""

from tofcorr.options.base import Options, OptionsT
from tofcorr.options.resolve import (
    is_shipped_name,
    load_options,
    resolve_options,
    shipped_file,
    shipped_names,
)
from tofcorr.options.yaml_files import dump_yaml, read_yaml

__all__ = [
    "Options",
    "OptionsT",
    "dump_yaml",
    "is_shipped_name",
    "load_options",
    "read_yaml",
    "resolve_options",
    "shipped_file",
    "shipped_names",
]
