"""Views of a board, rendered once, and the command that imports them."""

import shutil
from pathlib import Path
from typing import Any

import pytest
from importing.checkerboard.imported_board import ERROR, LENS, PLACEMENTS, Run
from importing.checkerboard.rendered_board import write_view
from running import Program, Said


@pytest.fixture(scope="session")
def rendered(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("rendered") / "images"
    for i, where in enumerate(PLACEMENTS):
        write_view(folder, f"{i}", where, error=ERROR)
    return folder


@pytest.fixture
def images(rendered: Path, tmp_path: Path) -> Path:
    """Rendered views to spoil."""
    return shutil.copytree(rendered, tmp_path / "images")


@pytest.fixture
def run(program: Program, tmp_path: Path) -> Run:
    """Call the command line; return exit code, standard output and standard error."""

    def call(folder: Path, *options: str, board: str = "5x7", lens: Any = LENS) -> Said:
        given = ("--board", board, "--square-mm", "30", "--out", tmp_path / "recording")
        return program("import", "checkerboard", folder, *given, *lens, *options)

    return call
