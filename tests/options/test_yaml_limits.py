"""YAML that is small and means much, or that means two things, ends at once with one sentence."""

import pytest

from tofcorr.errors import ConfigError
from tofcorr.options import dump_yaml, parse_yaml


def doubled(entry: str) -> str:
    """Return 40 lines, each of which holds the one before twice."""
    lines = ["a0: &a0 {k: 1}"]
    lines += [f"a{n}: &a{n} {entry.replace('@', f'*a{n - 1}')}" for n in range(1, 41)]
    return "\n".join(lines)


BOMBS = {
    # It hung for hours: every merge copies all keys of the one before.
    "merged mappings": (doubled("{<<: [@, @]}"), "more than 1000000 values once its aliases"),
    "lists of lists": (doubled("[@, @]"), "more than 1000000 values once its aliases"),
    "an endless alias": ("a: &a [*a]", "the alias in line 1 repeats the entry that holds it"),
    # The parser of libyaml overflowed its stack and ended the process.
    "deep brackets": ("[" * 100_000, "nested more than 100 levels deep in line 1"),
    "deep items": ("- " * 100_000, "nested more than 100 levels deep in line 1"),
    # The last one was silently taken.
    "a key twice": ("a: 1\nb: {c: 1, c: 2}\n", "the key 'c' in line 2 stands twice"),
    "a key twice, in JSON": ('{"width": 1, "width": 2}', "the key 'width' in line 1 stands twice"),
}


@pytest.mark.parametrize("name", BOMBS)
def test_it_is_refused_in_one_sentence(name: str) -> None:
    text, message = BOMBS[name]
    with pytest.raises(ConfigError, match=message) as refusal:
        parse_yaml(text, "file.yaml")
    assert "\n" not in str(refusal.value)
    assert len(str(refusal.value)) < 300


def test_aliases_and_merges_of_usual_size_are_read() -> None:
    text = "base: &base {degree: 3, kind: spline}\nother: {<<: *base, degree: 4}\nagain: *base"
    values = parse_yaml(text, "file.yaml")
    assert values["other"] == {"degree": 4, "kind": "spline"}
    assert values["again"] == {"degree": 3, "kind": "spline"}


def test_a_text_cut_anywhere_lacks_the_key_that_is_written_last() -> None:
    text = dump_yaml({"kind": "radial", "size": [3, 4], "rate": 5.0}, last="kind")
    assert text.endswith("kind: radial\n")
    for length in range(len(text) - 1):
        try:
            values = parse_yaml(text[:length], "file.yaml")
        except ConfigError:
            continue
        assert not isinstance(values, dict) or values.get("kind") != "radial"
