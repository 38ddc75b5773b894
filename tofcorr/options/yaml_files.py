"""YAML text in and out: bounded in size, so that no file can stop the program."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from tofcorr.errors import ConfigError
from tofcorr.options.base import one_line

_MOST_BYTES = 16_000_000
"""Largest file read, bytes. A simulator with one fixed-pattern value for each pixel of a VGA camera
takes 5 MB, the largest file that tofcorr itself writes."""

_MOST_NODES = 1_000_000
"""Most keys, values and lists of a document, with every alias written out. The same simulator has
0.3 million. Aliases of aliases ("billion laughs") double the number with every line."""

_DEEPEST = 100
"""Most levels of lists and mappings inside each other. Ten times those of the deepest shipped
configuration; the fast parser calls itself for every level and would overflow its stack."""

# The parser of libyaml is ten times as fast as the one in Python, which needs 12 s for a list of
# 300 000 numbers. Not every installation of PyYAML has it.
_LOADER: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
# And its writer four times as fast.
_DUMPER: Any = getattr(yaml, "CSafeDumper", yaml.SafeDumper)
# PyYAML lets more than its own error through: a tag such as !!bool before a value that it does
# not fit ends in a KeyError, IndexError or AttributeError.
_NOT_YAML = (yaml.YAMLError, ValueError, LookupError, AttributeError, RecursionError)


def read_yaml(path: Path) -> Any:  # noqa: ANN401 - YAML may hold anything
    """Read one YAML file.

    Raises:
        ConfigError: The file is missing, unreadable, too large or not YAML.
    """
    return parse_yaml(read_text(path), str(path))


def read_text(path: Path) -> str:
    """Return the text of a file of bounded size.

    Raises:
        ConfigError: The file is missing, unreadable, too large or not UTF-8.
    """
    try:
        with path.open("rb") as file:
            content = file.read(_MOST_BYTES + 1)
        if len(content) > _MOST_BYTES:
            raise ConfigError(
                f"{path}: larger than {_MOST_BYTES // 10**6} MB, the limit of such a file here."
            )
        return content.decode("utf-8")
    except FileNotFoundError:
        raise ConfigError(f"{path}: there is no such file.") from None
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read as text ({error}).") from None


def parse_yaml(text: str, where: str) -> Any:  # noqa: ANN401 - YAML may hold anything
    """Return the value of YAML text.

    Args:
        text: One document.
        where: What to call the source in an error message.

    Raises:
        ConfigError: The text is not YAML, or its aliases expand to too much.
    """
    try:
        _refuse_depth(text, where)
        loader = _LOADER(text)  # Refuses control characters already.
        root = loader.get_single_node()
        if root is None:
            return None
        _refuse_expansion(root, where)
        return loader.construct_document(root)
    except ConfigError:
        raise
    except _NOT_YAML as error:
        in_one_line = one_line(" ".join(str(error).split()))
        raise ConfigError(f"{where}: not valid YAML: {in_one_line}") from None


def dump_yaml(values: Mapping[str, Any], last: str = "") -> str:
    """Return `values` as YAML text, keys in the order given.

    Args:
        values: Plain values.
        last: A key that a reader needs, and which is written last: a copy of the text that was cut
            short is then refused.
    """
    ordered = {key: value for key, value in values.items() if key != last}
    ordered |= {last: values[last]} if last else {}
    return yaml.dump(ordered, Dumper=_DUMPER, sort_keys=False, allow_unicode=True, width=100)


def _refuse_depth(text: str, where: str) -> None:
    """Refuse a document that is nested too deeply, or holds too much, before it is built."""
    depth = 0
    for number, event in enumerate(yaml.parse(text, Loader=_LOADER)):
        if isinstance(event, yaml.CollectionStartEvent):
            depth += 1
        elif isinstance(event, yaml.CollectionEndEvent):
            depth -= 1
        if depth > _DEEPEST:
            raise ConfigError(
                f"{where}: lists and mappings are nested more than {_DEEPEST} levels deep in line "
                f"{event.start_mark.line + 1}."
            )
        if number > 2 * _MOST_NODES:
            raise ConfigError(f"{where}: more than {_MOST_NODES} values; that is no configuration.")


def _refuse_expansion(root: yaml.Node, where: str) -> None:
    """Refuse a document whose aliases, written out, make too many nodes or have no end."""
    sizes: dict[int, int | None] = {}  # By id of the node; None while its children are counted.

    def size(node: yaml.Node) -> int:
        known = sizes.get(id(node), 0)
        if known is None:
            line = node.start_mark.line + 1
            raise ConfigError(f"{where}: the alias in line {line} repeats the entry that holds it.")
        if known:
            return known
        sizes[id(node)] = None
        _refuse_doubled(node, where)
        total = 1 + sum(size(child) for child in _children(node))
        if total > _MOST_NODES:
            raise ConfigError(
                f"{where}: more than {_MOST_NODES} values once its aliases are written out; "
                "the limit keeps a small file from filling the memory."
            )
        sizes[id(node)] = total
        return total

    size(root)


def _refuse_doubled(node: yaml.Node, where: str) -> None:
    """Refuse a key that stands twice in one mapping: YAML would silently take the last."""
    if not isinstance(node, yaml.MappingNode):
        return
    seen: set[str] = set()
    for key, _ in node.value:
        name = key.value if isinstance(key, yaml.ScalarNode) else None
        if name in seen and name != "<<":
            line = key.start_mark.line + 1
            raise ConfigError(f"{where}: the key '{one_line(name)}' in line {line} stands twice.")
        if name is not None:
            seen.add(name)


def _children(node: yaml.Node) -> list[yaml.Node]:
    if isinstance(node, yaml.MappingNode):
        return [one for pair in node.value for one in pair]
    return node.value if isinstance(node, yaml.SequenceNode) else []
