"""Names and paths in the documents exist in the repository."""

import re
from functools import cache
from pathlib import Path

import pytest
from docs.pages import PAGES, ROOT, title

_SOURCES = ("tofcorr", "configs", "scripts", "benchmarks", "examples")
_SUFFIXES = frozenset({".py", ".yaml", ".j2", ".cpp", ".txt"})
_CODE = re.compile(r"(?<!`)`([^`\n]+)`(?!`)")
_FENCED = re.compile(r"^[ \t]*```.*?^[ \t]*```", re.DOTALL | re.MULTILINE)
# A name of Python, YAML or JSON, dotted or called; and a file of this repository.
_NAME = re.compile(r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)*(\(.*\))?")
_FILE = re.compile(r"[\w.-]+(/[\w.-]+)+\.(py|sh|toml|yml|svg)")
# Endings of names, which are no names of their own; and a frame that camera drivers of ROS publish.
_ELSEWHERE = frozenset({"_mm", "_us", "_deg", "_optical", "camera_link"})


@cache
def _words() -> frozenset[str]:
    """Return every word of the sources, and of the fenced examples in the documents."""
    files = [ROOT / "pyproject.toml", ROOT / "docs" / "conf.py"]
    for folder in _SOURCES:
        files += [path for path in (ROOT / folder).rglob("*") if path.suffix in _SUFFIXES]
    texts = [path.read_text(encoding="utf-8") for path in files]
    texts += [str(path.relative_to(ROOT)) for path in (*files, *ROOT.iterdir())]
    texts += ["\n".join(_FENCED.findall(page.read_text(encoding="utf-8"))) for page in PAGES]
    return frozenset(word for text in texts for word in re.findall(r"\w+", text))


def _unknown(text: str) -> list[str]:
    """Return the names of a page that no source contains, and the files that are not there."""
    spans = _CODE.findall(_FENCED.sub("", text))
    names = [span for span in spans if _NAME.fullmatch(span)]
    unknown = [n for n in names if not set(re.findall(r"\w+", n.partition("(")[0])) <= _words()]
    places = [ROOT, ROOT / "tofcorr", ROOT / "docs"]
    for span in spans:
        found = any((place / span).exists() for place in places)
        if _FILE.fullmatch(span) and not found:
            unknown.append(span)
    return [name for name in unknown if name not in _ELSEWHERE]


@pytest.mark.parametrize("page", PAGES, ids=title)
def test_names_of_page_exist(page: Path) -> None:
    assert _unknown(page.read_text(encoding="utf-8")) == []


def test_a_name_that_is_gone_would_be_noticed() -> None:
    text = "See `Recording.open`, `tofcorr/no_such_room/hall.py` and `recollection_moments`."
    assert _unknown(text) == ["recollection_moments", "tofcorr/no_such_room/hall.py"]
