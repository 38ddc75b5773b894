"""The drawn rooms are the rooms that the layers of pyproject.toml hold."""

import importlib.util
from types import ModuleType

import pytest
from docs.pages import ROOT


def _script() -> ModuleType:
    path = ROOT / "scripts" / "architecture_figure.py"
    spec = importlib.util.spec_from_file_location("architecture_figure", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


FIGURE = _script()


@pytest.mark.parametrize("name", FIGURE.FIGURES)
def test_figure_is_what_the_script_draws(name: str) -> None:
    drawn = FIGURE.FIGURES[name]()
    kept = (ROOT / "docs" / "assets" / name).read_text(encoding="utf-8")
    assert kept == drawn, "run: python scripts/architecture_figure.py"


def test_every_room_of_the_package_is_drawn() -> None:
    folder = ROOT / "tofcorr"
    found = {path.parent.name for path in folder.glob("*/__init__.py")}
    found |= {path.stem for path in folder.glob("*.py")} - {"__init__"}
    assert found == {room for layer in FIGURE.layers() for room in layer}
