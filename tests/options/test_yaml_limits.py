"""No YAML file can stop the program: size and aliases are bounded."""

from pathlib import Path

import pytest

from tofcorr.errors import ConfigError
from tofcorr.options import read_yaml
from tofcorr.options.yaml_files import parse_yaml

LEVELS = 30


def bomb(entry: str) -> str:
    """Return text whose size doubles on each of 30 lines once aliases are written out."""
    lines = [f"a{i}: &a{i} {entry.format(f'*a{i - 1}')}" for i in range(1, LEVELS)]
    return "\n".join(["a0: &a0 {x: 1}", *lines])


@pytest.mark.parametrize(
    "text",
    [bomb("[{0}, {0}]"), bomb("{{u: {0}, v: {0}}}"), bomb("{{<<: [{0}, {0}]}}")],
    ids=["lists", "mappings", "merge keys"],
)
def test_aliases_of_aliases_are_refused(text: str) -> None:
    with pytest.raises(ConfigError, match="more than 1000000 values once its aliases are written"):
        parse_yaml(text, "bomb")


@pytest.mark.parametrize("text", ["a: &a [*a]", "\na: &a {b: {c: *a}}", "a: &a\n  <<: *a\n"])
def test_an_alias_of_what_holds_it_is_refused(text: str) -> None:
    with pytest.raises(ConfigError, match=r"alias in line \d repeats the entry that holds it"):
        parse_yaml(text, "endless")


def test_plain_aliases_and_merge_keys_keep_their_meaning() -> None:
    text = "base: &base {degree: 3, kind: d}\nother: {<<: *base, degree: 4}\nsame: *base\n"
    assert parse_yaml(text, "text") == {
        "base": {"degree": 3, "kind": "d"},
        "other": {"degree": 4, "kind": "d"},
        "same": {"degree": 3, "kind": "d"},
    }


@pytest.mark.parametrize("text", ["", "# only a comment\n"])
def test_an_empty_document_is_nothing(text: str) -> None:
    assert parse_yaml(text, "text") is None


def test_two_documents_are_refused() -> None:
    with pytest.raises(ConfigError, match="not valid YAML: expected a single document"):
        parse_yaml("a: 1\n---\nb: 2\n", "text")


def test_a_huge_file_is_refused_without_being_read(tmp_path: Path) -> None:
    huge = tmp_path / "huge.yaml"
    with huge.open("wb") as file:
        file.truncate(10**12)  # Sparse: it takes no space.
    with pytest.raises(ConfigError, match=r"huge\.yaml: larger than 16 MB"):
        read_yaml(huge)
