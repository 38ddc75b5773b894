"""Write docs/thresholds.md: every named number of the package, with its comment.

    python scripts/thresholds_page.py

A named number is a constant of a module whose value consists of numbers. Its comment stands above
it, or below it as a docstring; neighbours without a line between them share one. The first sentence
says what the number does, the rest why it has this value. A test compares the page with the source.
"""

import ast
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import click

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "tofcorr"
PAGE = ROOT / "docs" / "thresholds.md"

HEAD = """\
# Thresholds

Every named number of the package: what it does, in which unit, and where it comes from. The texts
are the comments in the source; `python scripts/thresholds_page.py` copies them here. What a user
can change is not listed: `tofcorr configs NAME` prints the options of a configuration, with their
meaning.

*Chosen* and *set by hand* mean that somebody decided: no derivation and no benchmark stands behind
the value. Numbers that share a row share a comment. In the column of units a dash stands for a
count, a share or a ratio.
"""
TABLE = "| constant | unit | what it does | why this value |\n|---|---|---|---|\n"
_LONGEST = 60
"""Values of more characters are cut short on the page."""
_UNITS = {
    r"1 / m\^2": "1 / m²",
    r"m\^2|square metres": "m²",
    r"metres and radians": "m, rad",
    r"metres or radians": "m, rad",
    r"metres per second": "m/s",
    "millimetres": "mm",
    "metres": "m",
    "seconds": "s",
    "radians": "rad",
    "degrees": "°",
    "pixels": "px",
    "Hz": "Hz",
    "bytes": "bytes",
    "frames": "frames",
}
"""How a comment states a unit, after a comma or in brackets, and how the page does."""
_UNIT = re.compile(rf"(?:, |\()({'|'.join(_UNITS)})(?=[\s.,:;)])", re.IGNORECASE)
_CALLED = {"math.radians", "np.radians", "np.cos", "Interval", "tuple", "range"}
"""Functions that a named number may be written with."""
_SENTENCE_END = re.compile(r"(?<!e\.g)\. (?=[A-Z`0-9])")
_CLAUSE_END = re.compile(r": |; |,? (?=so that |because )")


@dataclass(frozen=True)
class NamedNumber:
    """A constant of a module, or neighbours that share a comment.

    Attributes:
        module: Path of the file below the package.
        names: Of the constants.
        values: Their values as the source writes them.
        comment: What the source says about them; empty if nothing.
    """

    module: str
    names: tuple[str, ...]
    values: tuple[str, ...]
    comment: str

    @property
    def units(self) -> str:
        """The units that the comment states; a dash if it states none."""
        found = [_unit(match[1]) for match in _UNIT.finditer(self.comment)]
        found += ["rad"] if any("math.radians" in value for value in self.values) else []
        return ", ".join(dict.fromkeys(found)) or "–"

    @property
    def purpose(self) -> str:
        """The first sentence, or its first clause where there is only one sentence."""
        return self._divided()[0]

    @property
    def origin(self) -> str:
        """What follows the purpose; empty if nothing does."""
        return self._divided()[1]

    def _divided(self) -> tuple[str, str]:
        end = _SENTENCE_END.search(self.comment) or _CLAUSE_END.search(self.comment)
        if end is None:
            return self.comment, ""
        purpose, origin = self.comment[: end.start()], self.comment[end.end() :]
        # A sentence begins with a capital; an identifier such as `k1` keeps its own letters.
        if re.match(r"[a-z]+['s]*( |\.|,)", origin):
            origin = origin[:1].upper() + origin[1:]
        return purpose.rstrip(".") + ".", origin


def named_numbers(path: Path) -> Iterator[NamedNumber]:
    """Yield the named numbers of one file in order, neighbours with one comment together."""
    text = path.read_text(encoding="utf-8")
    lines, body = text.splitlines(), ast.parse(text).body
    group: list[tuple[str, str]] = []
    comment, end = "", 0
    module = path.relative_to(PACKAGE).as_posix()
    for node, after in zip(body, [*body[1:], None], strict=True):
        if not _is_number(node):
            continue
        assert isinstance(node, ast.Assign)
        above = _comment_above(lines, node.lineno)
        docstring = _docstring(after)
        if group and (above or docstring or node.lineno > end + 1):
            yield _grouped(module, group, comment)
            group, comment = [], ""
        comment = comment or above or docstring
        group.append((ast.unparse(node.targets[0]).strip("()"), _value(lines, node)))
        end = node.end_lineno or node.lineno
        if docstring:
            yield _grouped(module, group, comment)
            group, comment = [], ""
    if group:
        yield _grouped(module, group, comment)


def all_named_numbers() -> list[NamedNumber]:
    """Return the named numbers of the package, file by file."""
    return [number for path in sorted(PACKAGE.rglob("*.py")) for number in named_numbers(path)]


def page(numbers: Iterable[NamedNumber]) -> str:
    """Return the text of the page."""
    parts, room = [HEAD], ""
    for number in numbers:
        own = number.module.partition("/")[0].removesuffix(".py")
        if own != room:
            room = own
            parts.append(f"\n## {room}\n\n{TABLE}")
        pairs = zip(number.names, number.values, strict=True)
        named = "<br>".join(f"`{name}` = `{value}`" for name, value in pairs)
        cells = (
            f"{named}<br><small>{number.module.replace('/', '/<wbr>')}</small>",
            number.units,
            _cell(number.purpose),
            _cell(number.origin) or "–",
        )
        parts.append(f"| {' | '.join(cells)} |\n")
    return "".join(parts)


def _is_number(node: ast.stmt) -> bool:
    """Return whether a statement gives a name to a number, or to numbers side by side."""
    if not isinstance(node, ast.Assign):
        return False
    inside = list(ast.walk(node.value))
    keys = {id(key) for part in inside if isinstance(part, ast.Dict) for key in part.keys}
    leaves = [p.value for p in inside if isinstance(p, ast.Constant) and id(p) not in keys]
    called = {ast.unparse(part.func) for part in inside if isinstance(part, ast.Call)}
    attributes = {ast.unparse(part) for part in inside if isinstance(part, ast.Attribute)}
    return (
        bool(leaves)
        and all(type(leaf) in (int, float) for leaf in leaves)
        and called | attributes <= _CALLED
        and not any(isinstance(part, ast.Subscript | ast.Lambda) for part in inside)
    )


def _comment_above(lines: list[str], line: int) -> str:
    above: list[str] = []
    for text in reversed(lines[: line - 1]):
        if not text.startswith("#"):
            break
        above.insert(0, text.removeprefix("#").strip())
    return " ".join(above)


def _docstring(node: ast.stmt | None) -> str:
    if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
        return " ".join(str(node.value.value).split())
    return ""


def _value(lines: list[str], node: ast.Assign) -> str:
    """Return the value as the source writes it, on one line, cut short if it is long."""
    # Lines without the node cost `get_source_segment` time: the page has hundreds of values.
    own = lines[node.lineno - 1 : node.end_lineno]
    value = ast.parse("\n".join(own)).body[0]
    assert isinstance(value, ast.Assign)
    text = " ".join((ast.get_source_segment("\n".join(own), value.value) or "").split())
    return text if len(text) <= _LONGEST else f"{text[: _LONGEST - 1]}…"


def _grouped(module: str, group: list[tuple[str, str]], comment: str) -> NamedNumber:
    names, values = zip(*group, strict=True)
    return NamedNumber(module=module, names=names, values=values, comment=comment)


def _unit(words: str) -> str:
    return next(u for pattern, u in _UNITS.items() if re.fullmatch(pattern, words, re.IGNORECASE))


def _cell(text: str) -> str:
    """Return text for a cell of a table: nothing in it is Markdown of its own."""
    return re.sub(r"([|*_<>])", r"\\\1", text) if "`" not in text else text.replace("|", r"\|")


@click.command()
def main() -> None:
    """Write docs/thresholds.md: every named number of the package, with its comment."""
    PAGE.write_text(page(all_named_numbers()), encoding="utf-8")


if __name__ == "__main__":
    main()
