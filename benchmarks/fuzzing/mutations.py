"""Random changes of bytes, of text, and of keys and values."""

import copy
import datetime
import math
import random
from collections.abc import Callable
from typing import Any

HOSTILE: list[Any] = [
    *(None, True, False, 0, 1, -1, 2, 7, 10**6, 2**31, -(2**63), 10**30, 10**400),
    *(0.0, -0.0, 0.5, 1.5, -1e-3, 1e-9, 1e-320, 1e6, 1e12, 1.1e12, 1e30, 1e200, -1e308),
    *(math.inf, -math.inf, math.nan),
    *("", " ", "nan", "1e999", "1_0", "0x1p4", "null", "\u0663", "a\nb", "\x1b[31m", "x" * 3000),
    *("amplitude", "radial", "z", "auto", "none", "white", "../..", "\ud7ff\U0001f600"),
    *([], {}, [[]], [0], [1.0, 2.0], [None], {"a": 1}, {1: 2}, [[1.0, 0.0], [0.0]], ["a", "b"]),
    *(datetime.date(2026, 11, 22), b"\x00\xff"),
]
"""Values that a file may hold anywhere and that a program may not expect."""

TOKENS = [
    *(b"\x00", b"\xff\xfe", b"\n", b"\r", b",", b";", b":", b"-", b"#", b'"', b"'", b"[", b"}"),
    *(b"nan", b"inf", b"-inf", b"1e309", b"1e-320", b"0x10", b"1_0", b"9" * 400, b"-0", b"1e30"),
    *(b"!!python/object:os.system ", b"!!bool ", b"&a ", b"*a ", b"<<: ", b"\xe2\x80\xa8"),
    *(b"\t", b"{" * 200, b"[" * 2000, b"%", b"true", b"null", b"~", b"\xef\xbb\xbf", b"\xc3"),
]
"""Bytes that mean something in one of the formats of text."""


def change_bytes(content: bytes, generator: random.Random, reach: int | None = None) -> bytes:
    """Flip, overwrite, insert, cut out, repeat or truncate, once to three times.

    Args:
        content: What to change.
        generator: Source of randomness.
        reach: Changes begin before this byte; None: anywhere.
    """
    for _ in range(generator.choice((1, 1, 1, 2, 3))):
        end = min(len(content), reach or len(content))
        start = generator.randrange(end + 1)
        length = min(1 << generator.randrange(0, 9), len(content))
        kind = generator.randrange(7)
        if kind == 0 and start < len(content):
            flipped = content[start] ^ (1 << generator.randrange(8))
            content = content[:start] + bytes([flipped]) + content[start + 1 :]
        elif kind == 1:
            content = content[:start] + generator.randbytes(length) + content[start + length :]
        elif kind == 2:
            content = content[:start] + generator.choice(TOKENS) + content[start:]
        elif kind == 3:
            content = content[:start] + content[start + length :]
        elif kind == 4:
            content = content[:start] + content[start : start + length] + content[start:]
        elif kind == 5:
            content = content[:start]
        else:
            token = generator.choice(TOKENS)
            content = content[:start] + token + content[start + len(token) :]
    return content


def change_tree(tree: Any, generator: random.Random) -> Any:  # noqa: ANN401 - any YAML value
    """Change one to three entries of keys and values; the input is not modified."""
    changed = {"": copy.deepcopy(tree)}
    for _ in range(generator.choice((1, 1, 1, 2, 3))):
        holder, key = generator.choice(_entries(changed))
        generator.choice(_CHANGES)(holder, key, generator)
    return changed.get("")


def _entries(tree: Any, holder: Any = None, key: Any = None) -> list[tuple[Any, Any]]:  # noqa: ANN401
    found = [] if holder is None else [(holder, key)]
    if isinstance(tree, dict | list):
        for inner in list(tree) if isinstance(tree, dict) else range(len(tree)):
            found += _entries(tree[inner], tree, inner)
    return found


def _replace(holder: Any, key: Any, generator: random.Random) -> None:  # noqa: ANN401
    holder[key] = copy.deepcopy(generator.choice(HOSTILE))


def _scale(holder: Any, key: Any, generator: random.Random) -> None:  # noqa: ANN401
    value = holder[key]
    if isinstance(value, int | float) and not isinstance(value, bool):
        factor = generator.choice((-1, 0, 10, 1000, 1e6, 1e-6, 1e15, -1e300, 1.01, 1e-200))
        holder[key] = value * factor if abs(value) < 1e300 else generator.uniform(-2, 2)
    else:
        _replace(holder, key, generator)


def _remove(holder: Any, key: Any, generator: random.Random) -> None:  # noqa: ANN401
    del generator
    if key != "":
        del holder[key]


def _add(holder: Any, key: Any, generator: random.Random) -> None:  # noqa: ANN401
    value = copy.deepcopy(generator.choice(HOSTILE))
    if isinstance(holder, list):
        holder.insert(generator.randrange(len(holder) + 1), value)
    else:
        name = str(key)
        holder[generator.choice(("unknown", name[:-1], name + "s", name.upper(), 3))] = value


def _wrap(holder: Any, key: Any, generator: random.Random) -> None:  # noqa: ANN401
    value = holder[key]
    holder[key] = generator.choice(([value], [value, value], {"a": value}, str(value)))


def _repeat(holder: Any, key: Any, generator: random.Random) -> None:  # noqa: ANN401
    if isinstance(holder, list):
        holder[:] = holder * generator.choice((2, 3, 50))
    else:
        _swap(holder, key, generator)


def _swap(holder: Any, key: Any, generator: random.Random) -> None:  # noqa: ANN401
    other = generator.choice(list(holder) if isinstance(holder, dict) else range(len(holder)))
    holder[key], holder[other] = holder[other], holder[key]


_CHANGES: list[Callable[[Any, Any, random.Random], None]] = [
    *(_replace, _replace, _replace, _scale, _scale, _remove, _add, _wrap, _repeat, _swap),
]
