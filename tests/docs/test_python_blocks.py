"""Every Python block of the documents runs, page by page, with what the page made before it."""

import shutil
from pathlib import Path

import pytest
import yaml
from docs.pages import ADDING, PAGES, blocks, title

from tofcorr.options import configs_folder

RUNNING = [page for page in PAGES if page not in ADDING and "```python" in page.read_text("utf-8")]

# Options of a diagnosis that takes a fifth of the time, on a fraction of the pixels.
QUICK = {"bootstraps": 19, "most_pixels": 8_000}


@pytest.fixture
def quick_diagnosis(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the shipped configuration `many` look at fewer pixels, for the pages that diagnose."""
    folder = tmp_path / "configs"
    shutil.copytree(configs_folder(), folder)
    many = folder / "diagnose" / "many.yaml"
    options = yaml.safe_load(many.read_text(encoding="utf-8")) | QUICK
    many.write_text(yaml.safe_dump(options), encoding="utf-8")
    monkeypatch.setattr("tofcorr.options.configs_folder", lambda: folder)


@pytest.mark.usefixtures("quick_diagnosis")
@pytest.mark.parametrize("page", RUNNING, ids=title)
def test_blocks_of_page_run(
    page: Path, first_page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    shutil.copytree(first_page / "runs", tmp_path / "runs")
    names: dict[str, object] = {"__name__": "page"}
    for block in blocks(page):
        if block.language == "python":
            # Empty lines before it make line numbers in a traceback those of the page.
            code = compile("\n" * (block.line - 1) + block.text, str(page), "exec")
            exec(code, names)  # noqa: S102 - running it is the test
