"""The header row of a table of poses, and what its columns are called in plain words."""

import re
from typing import NamedTuple

_DELIMITERS = (",", ";", "\t")
_UNIT = re.compile(r"\s*[\[(]([^\])]*)[\])]$")
_PART = {"position": "", "translation": "", "orientation": "q", "rotation": "q"}
# As the EuRoC data set and others write: p_RS_R_x, q_RS_w.
_LETTER = re.compile(r"(?:p|(q))_(?:\w+_)?([wxyz])")
_COORDINATE = re.compile(r"[tp]?x(_m|_mm)?")


class Header(NamedTuple):
    """The header row of a table.

    Attributes:
        delimiter: What separates cells.
        columns: Plain names of the columns, see `plain_name`.
        line: As it stands in the text.
    """

    delimiter: str
    columns: list[str]
    line: str


def plain_name(text: str) -> str:
    """Return a column's name in lower case, without the message that it is part of.

    Units in brackets are joined by an underscore. A ROS message's parts become the letters that
    other tables use: positions and translations x, y, z, orientations and rotations qx, qy, qz, qw.

    Example:
        >>> [plain_name(name) for name in ("X [mm]", "pose.position.x", "/tf/base/rotation/w")]
        ['x_mm', 'x', 'qw']
        >>> [plain_name(name) for name in ("#timestamp [ns]", "q_RS_w []", "header.stamp.nanosec")]
        ['timestamp_ns', 'qw', 'stamp_nanosec']
    """
    name = text.strip().lower().lstrip("#%_ ")
    unit = _UNIT.search(name)
    ending = ""
    if unit is not None:
        name, ending = name[: unit.start()], f"_{unit[1].strip()}" if unit[1].strip() else ""
    *path, last = re.split(r"[./]", name)
    if path and path[-1] in _PART:
        name = _PART[path[-1]] + last
    elif path and path[-1] == "stamp":
        name = f"stamp_{last}"
    elif last == "stamp":
        name = last
    letter = _LETTER.fullmatch(name)
    if letter is not None:
        name = (letter[1] or "") + letter[2]
    return name + ending


def header_of(text: str) -> Header | None:
    """Return the header row of a text; None if its first line is a row of numbers.

    Comments above it are passed over. A line that begins like a comment, with `#` or `%`, is the
    header if it names coordinates and the line below has as many cells.
    """
    lines = [line for line in text.splitlines() if line.strip()]
    for line, below in zip(lines, [*lines[1:], ""], strict=False):
        delimiter = max(_DELIMITERS, key=line.count)
        cells = line.split(delimiter)
        columns = [plain_name(cell) for cell in cells]
        if line.lstrip()[0] not in "#%":
            numbers = all(_is_number(cell) for cell in line.replace(delimiter, " ").split())
            return None if numbers else Header(delimiter, columns, line)
        same = 1 < len(cells) == below.count(delimiter) + 1
        if same and any(_COORDINATE.fullmatch(name) for name in columns):
            return Header(delimiter, columns, line)
    return None


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
