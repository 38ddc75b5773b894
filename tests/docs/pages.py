"""The documents as tests see them: pages, and the fenced blocks in them."""

import re
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[2]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]

# Their examples run in a package that has them, in `tests/extending`.
ADDING = [page for page in PAGES if page.name.startswith("add-")]

_FENCE = re.compile(
    r"(?:<!-- not run: ([^>]+) -->\s*?\n\s*?)?^([ \t]*)```(\w+)[^\n]*\n(.*?)^\2```[ \t]*$",
    re.DOTALL | re.MULTILINE,
)


class Block(NamedTuple):
    """A fenced block.

    Attributes:
        language: The word after the opening fence.
        text: What stands between the fences, indentation of the fence removed.
        line: Line of its first character in the page, counted from 1.
        not_run: Why no test runs it, from a comment before it; empty: it is run.
    """

    language: str
    text: str
    line: int
    not_run: str = ""


def blocks(page: Path) -> list[Block]:
    """Return the fenced blocks of a page, in order."""
    text = page.read_text(encoding="utf-8")
    found = []
    for match in _FENCE.finditer(text):
        reason, indent, language, body = match.groups()
        lines = [line.removeprefix(indent) for line in body.splitlines(keepends=True)]
        line = text.count("\n", 0, match.start(4)) + 1
        found.append(Block(language, "".join(lines), line, (reason or "").strip()))
    return found


def title(page: Path) -> str:
    """Return how a test names a page."""
    return page.relative_to(ROOT).as_posix()
