"""Every block of README, the first page and the how-tos runs as it stands, in an empty folder.

So do the Python blocks of all other pages, in a folder that has what the first page makes.

Shell blocks run in bash, Python blocks in one Python for the page, with the program as a user has
it. A `text` block is what the block before it prints, numbers apart. `<!-- not run: REASON -->`
before a block says why a test cannot run it. `TOFCORR_WRITE_OUTPUTS=1` writes the numbers that were
printed into the pages.
"""

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from docs.pages import ADDING, ROOT, Block, blocks, title
from docs.pages import PAGES as EVERY
from running import printed

HERE = Path(__file__).parent
PAGES = [ROOT / "README.md", ROOT / "docs" / "index.md"]
PAGES += [one for one in sorted((ROOT / "docs" / "how-to").glob("*.md")) if one not in ADDING]
OTHERS = [
    one for one in EVERY if one not in (*PAGES, *ADDING) and "```python" in one.read_text("utf-8")
]
SLOW = ("README.md", "check.md", "choose.md", "deploy.md", "diagnose.md", "distance-sensor.md")
SLOW += ("install.md", "your-simulator.md", "after-a-bump.md", "two-cameras.md", "robot-errors.md")
SLOW += ("scene-light.md", "live.md", "robot-and-wall.md")
"""Pages that take many seconds, and those that only repeat what others run."""
FILES = ("yaml", "json", "text")
"""Languages of blocks that are no programs."""
_NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")
REPOSITORY = re.compile(r"(bash|python) scripts/|pip install")


def why_not_run(block: Block) -> str:
    """Return why a block is left out; empty: it is run."""
    if REPOSITORY.search(block.text):
        return "needs the repository, or the network"
    return block.not_run


def shape(line: str) -> str:
    """Return a line with every number as #, and every space as one."""
    return " ".join(_NUMBER.sub("#", line).split())


def unprinted(expected: str, said: str) -> list[str]:
    """Return the lines of a page that a program did not print, in this order; `...` ends any."""
    lines = iter([shape(line) for line in said.splitlines()])
    wanted = [line for line in map(shape, expected.splitlines()) if line not in ("", "...")]
    return [
        line
        for line in wanted
        if not any(
            one == line or (line.endswith("...") and one.startswith(line[:-3])) for one in lines
        )
    ]


def with_numbers_of(expected: str, said: str) -> str:
    """Return the lines of a page with the numbers that a program printed in lines like them."""
    printed, lines = said.splitlines(), list[str]()
    for line in expected.splitlines():
        shapes = [shape(one) for one in printed]
        first = shapes.index(shape(line)) if shape(line) in shapes else None
        lines.append(line if first is None else printed[first])
        printed = printed if first is None else printed[first + 1 :]
    return "\n".join(lines) + "\n"


class Installed(NamedTuple):
    """A tofcorr to run pages with: what starts Python, and the folder of its programs."""

    python: Sequence[str]
    programs: Path


@pytest.fixture(scope="session")
def warm(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Installed]:
    """The package as it stands in the repository, loaded once."""
    folder = tmp_path_factory.mktemp("warm")
    place, programs = str(folder / "socket"), folder / "bin"
    programs.mkdir()
    program = folder / "tofcorr"
    program.write_text("from tofcorr.cli.main import main\n\nmain()\n", encoding="utf-8")
    python = [sys.executable, "-SE", str(HERE / "warm_python.py"), place]
    script = programs / "tofcorr"
    script.write_text(f'#!/bin/sh\nexec {shlex.join([*python, str(program)])} "$@"\n')
    script.chmod(0o755)
    words = [sys.executable, str(HERE / "warm_python.py"), place]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    with subprocess.Popen(words, stdout=subprocess.PIPE, cwd=folder, env=environment) as server:
        assert server.stdout is not None
        assert server.stdout.readline() == b"ready\n"
        yield Installed(python, programs)
        server.terminate()


@pytest.fixture(scope="session")
def from_wheel(python_with_wheel: Path) -> Installed:
    """The package from its wheel, in an environment of its own."""
    return Installed([str(python_with_wheel)], python_with_wheel.parent)


def outcomes_of(
    page: Path, installed: Installed, folder: Path, languages: Sequence[str]
) -> list[dict[str, Any]]:
    """Run the blocks of a page in a folder; return what became of each, up to one that failed."""
    run = [
        {"language": one.language, "text": one.text, "line": one.line, "page": str(page)}
        for one in blocks(page)
        if one.language in languages and not why_not_run(one)
    ]
    listed = folder.with_name(f"{folder.name}.json")
    listed.write_text(json.dumps(run), encoding="utf-8")
    clean = {key: value for key, value in os.environ.items() if not key.startswith("PYTHON")}
    clean["PATH"] = f"{installed.programs}{os.pathsep}{clean['PATH']}"
    words = [*installed.python, HERE / "run_page.py", listed]
    printed(*words, cwd=folder, env=clean | {"HOME": str(folder), "OMP_NUM_THREADS": "1"})
    outcomes = json.loads(listed.with_suffix(".out.json").read_text(encoding="utf-8"))
    assert len(outcomes) == len(run) or not outcomes[-1]["ok"]
    return outcomes


def assert_runs(
    page: Path, installed: Installed, folder: Path, languages: Sequence[str] = ("bash", "python")
) -> None:
    """Every block of a page ends well, and prints what the page says."""
    outcomes = {one["line"]: one for one in outcomes_of(page, installed, folder, languages)}
    for one in outcomes.values():
        assert one["ok"], f"{title(page)}, line {one['line']}:\n{one['printed']}"
    said, missing, text = "", [], page.read_text(encoding="utf-8")
    for block in blocks(page):
        said = outcomes[block.line]["printed"] if block.line in outcomes else said
        if block.language == "text" and page in PAGES and not block.not_run:
            missing += unprinted(block.text, said)
            text = text.replace(block.text, with_numbers_of(block.text, said))
    if os.environ.get("TOFCORR_WRITE_OUTPUTS"):
        page.write_text(text, encoding="utf-8")
    assert not missing, f"{title(page)}: never printed: {missing}; printed: {said}"


@pytest.fixture
def folder(page: Path, tmp_path: Path, request: pytest.FixtureRequest) -> Path:
    """An empty folder; for README and pages that are no how-to, one with runs of the first page."""
    folder = tmp_path / "empty"
    folder.mkdir()
    if page.parent == ROOT or page not in PAGES:
        shutil.copytree(request.getfixturevalue("first_page") / "runs", folder / "runs")
    return folder


@pytest.mark.parametrize(
    "page",
    [pytest.param(p, marks=[pytest.mark.slow] if p.name in SLOW else []) for p in PAGES],
    ids=title,
)
def test_page_runs(page: Path, warm: Installed, folder: Path) -> None:
    assert_runs(page, warm, folder)


@pytest.mark.parametrize("page", [PAGES[0], *OTHERS], ids=title)
def test_python_of_page_runs(page: Path, warm: Installed, folder: Path) -> None:
    assert_runs(page, warm, folder, ["python"])


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES, ids=title)
def test_page_runs_with_the_wheel(page: Path, from_wheel: Installed, folder: Path) -> None:
    assert_runs(page, from_wheel, folder)


def test_every_block_runs_or_says_why_not() -> None:
    """`pytest -s` shows the list; the pages that add to the package run in `tests/extending`."""
    programs = [
        (page, one)
        for page in (*PAGES, *ADDING)
        for one in blocks(page)
        if one.language not in FILES
    ]
    left_out = [(page, one) for page, one in programs if why_not_run(one)]
    print(f"\n{len(programs) - len(left_out)} of {len(programs)} blocks run; not run:")  # noqa: T201
    for page, one in left_out:
        print(f"{title(page)}, line {one.line}: {why_not_run(one)}")  # noqa: T201
    assert {one.language for _, one in programs if not why_not_run(one)} == {"bash", "python"}
    assert {one.language for page, one in programs if page in ADDING} == {"python"}
    assert 5 * len(left_out) < len(programs)


def test_what_a_page_promises_and_a_program_does_not_print_would_be_noticed() -> None:
    said = "before   25.83  mm\nafter 1.80 mm, held out\nVerdict: good"
    assert unprinted("before 7 mm\n...\nafter 2 ...\n", said) == []
    assert unprinted("after 2 mm, held out\nbefore 7 mm\n", said) == ["before # mm"]
