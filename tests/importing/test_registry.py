"""Every importer is a sub-command that says what it does."""

import re
from importlib import import_module

import click
import pytest
from click.testing import CliRunner

from tofcorr.cli.main import group
from tofcorr.importing.registry import IMPORTERS


@pytest.mark.parametrize("name", IMPORTERS)
def test_every_importer_is_listed_writes_to_out_and_explains_its_options(name: str) -> None:
    command = import_module(f"tofcorr.importing.{name}").command
    assert command.name == name
    options = [option for option in command.params if isinstance(option, click.Option)]
    assert [option.required for option in options if option.name == "out"] == [True]
    assert [option.name for option in options if not option.help] == []
    listed = CliRunner().invoke(group, ["import", "--help"]).output
    assert re.search(rf"{name} +{re.escape(IMPORTERS[name])}", listed)
