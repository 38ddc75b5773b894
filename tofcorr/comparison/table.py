"""A table, as aligned text for a terminal or as Markdown."""

from collections.abc import Sequence
from typing import NamedTuple


class Table(NamedTuple):
    """Cells with a title above and a note below.

    Attributes:
        title: What the table shows.
        header: Headings of the columns.
        rows: Cells, as many a row as there are headings.
        note: What the numbers are and how they were found.
    """

    title: str
    header: list[str]
    rows: list[list[str]]
    note: str

    def text(self) -> str:
        """Return the table as text, the first column aligned left and the others right."""
        lines = [self.header, *self.rows]
        widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
        aligned = [
            "  ".join([line[0].ljust(widths[0]), *map(str.rjust, line[1:], widths[1:])]).rstrip()
            for line in lines
        ]
        rule = "-" * (sum(widths) + 2 * len(widths) - 2)
        return "\n".join([self.title, rule, aligned[0], rule, *aligned[1:], rule, self.note])

    def markdown(self) -> str:
        """Return a Markdown table."""
        rule = [":--", *["--:"] * (len(self.header) - 1)]
        lines = [_markdown_row(line) for line in [self.header, rule, *self.rows]]
        return "\n".join([f"**{self.title}**", "", *lines, "", self.note])


def _markdown_row(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"
