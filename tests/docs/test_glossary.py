"""The glossary keeps its promise: short entries, each word once."""

import re

from docs.pages import ROOT

ENTRY = re.compile(r"^\*\*(.+?)\*\*\n:   (.+?)(?=\n\n|\Z)", re.DOTALL | re.MULTILINE)
ENTRIES = ENTRY.findall((ROOT / "docs" / "glossary.md").read_text(encoding="utf-8"))


def test_every_word_stands_once_in_25_words_at_most() -> None:
    assert len(ENTRIES) > 30
    assert {word: len(text.split()) for word, text in ENTRIES if len(text.split()) > 25} == {}
    words = [word for word, _ in ENTRIES]
    assert sorted(words) == sorted(set(words))
