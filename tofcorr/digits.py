"""Numbers and tables as text: no more digits than are known, no more lines than are read."""

import math
from collections.abc import Iterable, Sequence

# An interval's half-width is at least so many of the units it is written in: 0.8 is written in
# tenths, 2.1 too, 12 in ones, 40 in tens. The rounding rule of the Particle Data Group: two digits
# of an uncertainty below 3.55, one above.
_UNITS_OF_HALF = 3.55


def decimals(interval: tuple[float, float], most: int) -> int:
    """Return how many decimals are known; negative: tens, hundreds, ... are not known.

    Args:
        interval: Lower and upper end.
        most: The largest number of decimals that is ever written.
    """
    half = abs(interval[1] - interval[0]) / 2
    if not math.isfinite(half) or half <= 0:
        return most
    return min(most, -math.floor(math.log10(half / _UNITS_OF_HALF)))


def known(value: float, interval: tuple[float, float], most: int = 1, sign: str = "") -> str:
    """Return a value with the digits that its interval leaves known.

    Args:
        value: The value.
        interval: Its interval, in the same unit.
        most: The largest number of decimals.
        sign: `+` writes the sign of positive values too.

    Example:
        >>> known(10386.5, (126.3, 2588419.2)), known(12.86, (12.1, 13.8))
        ('0', '12.9')
    """
    return _written(value, decimals(interval, most), sign)


def known_interval(interval: tuple[float, float], most: int = 1, sign: str = "") -> list[str]:
    """Return the ends of an interval with the digits that are known."""
    return [_written(end, decimals(interval, most), sign) for end in interval]


def with_interval(value: float | None, ends: Sequence[float | None] | None) -> tuple[str, str]:
    """Return a value of any size, and its interval, with the digits that are known.

    Args:
        value: The value; None: unknown, written as a dash.
        ends: Of its interval; None, or an end of None: not known, and not written.
    """
    if value is None:
        return "–", ""
    low, high = ends or (None, None)
    interval = (value, value) if low is None or high is None else (low, high)
    largest = max(abs(value), *map(abs, interval))
    power = math.floor(math.log10(largest)) if largest else 0
    # Up to five digits before or after the point are read at a glance.
    if -3 <= power < 5:
        numbers = [known(number, interval, 6) for number in (value, *interval)]
    else:  # Pixel terms are as small as 1e-12 m / pixel^4.
        digits = max(power + decimals(interval, 16), 1)
        numbers = [f"{number:.{min(digits, 3)}e}" for number in (value, *interval)]
    return numbers[0], "" if interval[0] == interval[1] else " to ".join(numbers[1:])


def in_mm(millimetres: float | None) -> str:
    """Return a length for a page, without its unit; None is a dash."""
    if millimetres is None:
        return "–"
    return f"{millimetres:z.1f}" if round(abs(millimetres), 1) >= 1 else f"{millimetres:z.2f}"


def _written(value: float, places: int, sign: str) -> str:
    if not math.isfinite(value):
        return "unknown"
    text = f"{round(value, places):{sign}.{max(places, 0)}f}"
    return text.removeprefix("-") if float(text) == 0 else text


def aligned(rows: Iterable[Sequence[str]]) -> list[str]:
    """Return rows of cells as lines, the first column aligned left and the others right."""
    table = list(rows)
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    cells = ([a.ljust(widths[0]), *map(str.rjust, others, widths[1:])] for a, *others in table)
    return ["  ".join(line).rstrip() for line in cells]


def at_most(number: int, lines: Sequence[str], where: str = "--verbose") -> list[str]:
    """Return lines that a user can read at once; the last one says how many more there are.

    Args:
        number: How many lines are returned at most.
        lines: The most important first.
        where: What shows the others.
    """
    if len(lines) <= number:
        return [*lines]
    return [*lines[: number - 1], f"... and {len(lines) - number + 1} more: {where}"]
