"""The pages on adding a term, an effect, an importer and a format: their examples are built in.

Each page's file goes into a copy of the package, its line into the registry, and every other Python
block runs there. Nothing else of the package is touched.
"""

from pathlib import Path

import pytest
from docs.pages import ROOT, Block, blocks, title
from extended_package import extend

PAGES = sorted((ROOT / "docs" / "how-to").glob("add-*.md"))
# The text in each registry in front of which the line goes.
END_OF_LIST = {
    "error_terms": ")\n# Not a term",
    "simulation": ")\n\n\ndef _effect",
    "importing": ")\n\nIMPORTERS",
    "correction": ")\n\nFORMATS",
}


def _path(block: Block) -> str | None:
    """Return the file that a block is part of, named by its first line."""
    first = block.text.splitlines()[0]
    return first.removeprefix("# tofcorr/") if first.startswith("# tofcorr/") else None


@pytest.mark.parametrize("page", PAGES, ids=title)
def test_example_takes_one_file_and_one_line(
    page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    code = [block for block in blocks(page) if block.language == "python"]
    (new, line), rest = [b for b in code if _path(b)], [b for b in code if not _path(b)]
    assert rest, "the page shows no use"
    registry = str(_path(line))
    package = extend(
        tmp_path,
        (str(_path(new)), new.text),
        registry,
        END_OF_LIST[registry.split("/", maxsplit=1)[0]],
        line.text.splitlines()[1],
    )
    package.run("\n".join(block.text for block in rest))
