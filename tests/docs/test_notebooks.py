"""The notebooks of the documents run from the first cell to the last."""

from pathlib import Path

import nbformat
import pytest
from docs.pages import ROOT, title
from nbclient import NotebookClient

NOTEBOOKS = sorted((ROOT / "docs" / "notebooks").glob("*.ipynb"))


@pytest.mark.parametrize("path", NOTEBOOKS, ids=title)
def test_notebook_runs(path: Path, tmp_path: Path) -> None:
    notebook = nbformat.read(path, as_version=4)
    where = {"metadata": {"path": str(tmp_path)}}
    client = NotebookClient(
        notebook, kernel_name="python3", timeout=300, startup_timeout=300, resources=where
    )
    client.execute()


@pytest.mark.parametrize("path", NOTEBOOKS, ids=title)
def test_notebook_is_kept_with_its_pictures(path: Path) -> None:
    notebook = nbformat.read(path, as_version=4)
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    assert any("image/png" in output.get("data", {}) for output in outputs)
    assert not [output for output in outputs if output.output_type == "error"]
