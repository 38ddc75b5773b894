"""Every Python block of the documents runs, page by page, with what the page made before it."""

import shutil
from pathlib import Path

import pytest
from docs.pages import blocks, pages_with, title
from docs.shell import run_command, tofcorr_commands


@pytest.fixture(scope="session")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What `scripts/run.sh` leaves for the Python blocks: runs/demo with recording and run."""
    folder = tmp_path_factory.mktemp("demo")
    run_command(f"tofcorr simulate --config demo --out {folder / 'recording'}")
    run_command(
        f"tofcorr train --config ea --recording {folder / 'recording'} --out {folder / 'run'}"
    )
    return folder


# The examples of how-to/add-*.md run in `test_extension_pages`, in a package that has them.
PAGES = [page for page in pages_with("python") if not page.name.startswith("add-")]


@pytest.mark.parametrize("page", PAGES, ids=title)
def test_blocks_of_page_run(
    page: Path, demo: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    shutil.copytree(demo, tmp_path / "runs" / "demo")
    names: dict[str, object] = {"__name__": "page"}
    for block in blocks(page):
        if block.language == "python":
            # Empty lines before it make line numbers in a traceback those of the page.
            code = compile("\n" * (block.line - 1) + block.text, str(page), "exec")
            exec(code, names)  # noqa: S102 - running it is the test


def test_every_command_of_the_first_page_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (page,) = [page for page in pages_with("bash") if title(page) == "docs/index.md"]
    for command in tofcorr_commands(page):
        run_command(command)
    assert (tmp_path / "runs/demo/run/corrector.ts").is_file()
