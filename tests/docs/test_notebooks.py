"""The notebooks of the documents run from the first cell to the last."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import matplotlib as mpl
import pytest
from docs.pages import ROOT, title
from matplotlib import pyplot as plt

NOTEBOOKS = sorted((ROOT / "docs" / "notebooks").glob("*.ipynb"))


def code_cells(path: Path) -> list[dict[str, Any]]:
    """Return the cells of code, in order."""
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    return [cell for cell in cells if cell["cell_type"] == "code"]


@pytest.fixture
def figures_on_no_screen() -> Iterator[None]:
    """Draw figures in memory, and forget them after the test."""
    with mpl.rc_context({"backend": "agg"}):
        yield
        plt.close("all")


# What Matplotlib warns of is no error of the notebook.
@pytest.mark.filterwarnings("ignore")
@pytest.mark.usefixtures("figures_on_no_screen")
@pytest.mark.parametrize("path", NOTEBOOKS, ids=title)
def test_notebook_runs(path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The cells are plain Python: a kernel of its own would only load torch once more."""
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {"__name__": "notebook"}
    for number, cell in enumerate(code_cells(path), 1):
        exec(compile("".join(cell["source"]), f"{path}, cell {number}", "exec"), names)  # noqa: S102 - running it is the test
    assert plt.get_fignums(), "the notebook shows no figure"
    for number in plt.get_fignums():
        plt.figure(number).canvas.draw()


@pytest.mark.parametrize("path", NOTEBOOKS, ids=title)
def test_notebook_is_kept_with_its_pictures(path: Path) -> None:
    outputs = [output for cell in code_cells(path) for output in cell["outputs"]]
    assert any("image/png" in output.get("data", {}) for output in outputs)
    assert not [output for output in outputs if output["output_type"] == "error"]
