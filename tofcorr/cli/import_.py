"""`tofcorr import`: recorded images become a recording, one sub-command per importer."""

import click

from tofcorr.cli.lazy_group import Entry, LazyGroup
from tofcorr.importing.registry import IMPORTERS


@click.group(
    cls=LazyGroup,
    entries={
        name: Entry(f"tofcorr.importing.{importer.module}", importer.summary)
        for name, importer in IMPORTERS.items()
    },
    context_settings={"help_option_names": ["-h", "--help"]},
)
def command() -> None:
    """Turn recorded images into a recording."""
