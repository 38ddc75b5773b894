"""What the pages of the documents start from."""

from pathlib import Path

import pytest
from docs.pages import ROOT
from docs.shell import run_command, tofcorr_commands


@pytest.fixture(scope="session")
def first_page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder in which the commands of the first page were run, as a visitor would."""
    folder = tmp_path_factory.mktemp("first_page")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        for command in tofcorr_commands(ROOT / "docs" / "index.md"):
            run_command(command)
    return folder
