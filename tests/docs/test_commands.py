"""Every `tofcorr` command of the documents is one that the program understands."""

from pathlib import Path

import click
import pytest
from docs.pages import PAGES, title
from docs.shell import parsed, tofcorr_commands

from tofcorr.cli.shared import ConfigName
from tofcorr.files import NewPath
from tofcorr.options import shipped_names

COMMANDS = [(page, line) for page in PAGES for line in tofcorr_commands(page)]


@pytest.fixture
def files_need_not_exist(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let a page talk about files and folders that are not there."""

    def convert(_: click.Path, value: str, *__: object) -> Path:
        return Path(value)

    for kind in (click.Path, NewPath):
        monkeypatch.setattr(kind, "convert", convert)


@pytest.mark.usefixtures("files_need_not_exist")
@pytest.mark.parametrize(
    ("page", "line"), COMMANDS, ids=[f"{title(page)}: {line}" for page, line in COMMANDS]
)
def test_command_parses_and_names_a_shipped_configuration(page: Path, line: str) -> None:
    context = parsed(line)
    if context is None:
        return
    for parameter in context.command.params:
        value = context.params.get(str(parameter.name))
        if isinstance(parameter.type, ConfigName) and value is not None and "." not in value:
            assert value in shipped_names(parameter.type.folder), page


def test_a_misspelt_option_would_be_noticed() -> None:
    with pytest.raises(click.NoSuchOption):
        parsed("tofcorr train --recordings wall --out run")
