"""The drawn rooms are the rooms that the layers of pyproject.toml hold."""

import pytest
from docs.pages import ROOT

from scripts import architecture_figure


@pytest.mark.parametrize("name", architecture_figure.FIGURES)
def test_figure_is_what_the_script_draws(name: str) -> None:
    drawn = architecture_figure.FIGURES[name]()
    kept = (ROOT / "docs" / "assets" / name).read_text(encoding="utf-8")
    assert kept == drawn, "run: python scripts/architecture_figure.py"


def test_every_room_of_the_package_is_drawn() -> None:
    folder = ROOT / "tofcorr"
    found = {path.parent.name for path in folder.glob("*/__init__.py")}
    found |= {path.stem for path in folder.glob("*.py")} - {"__init__"}
    assert found == {room for layer in architecture_figure.layers() for room in layer}
