"""A number is written with the digits that its interval leaves known."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tofcorr.digits import aligned, at_most, decimals, known, known_interval


@pytest.mark.parametrize(
    ("value", "interval", "written"),
    [
        (12.86, (12.1, 13.8), "12.9"),
        (4.14, (4.13, 4.15), "4.1"),
        (17.3, (5.0, 29.0), "17"),
        (138.2, (110.0, 165.0), "138"),
        (138.2, (90.0, 185.0), "140"),
        (10386.5, (126.3, 2588419.2), "0"),
        (0.04, (0.0, 0.06), "0.0"),
        (-0.04, (-0.1, 0.1), "0.0"),
        (5.26, (5.26, 5.26), "5.3"),
        (math.nan, (0.0, 1.0), "unknown"),
    ],
)
def test_the_digits_follow_the_interval(
    value: float, interval: tuple[float, float], written: str
) -> None:
    assert known(value, interval) == written


def test_a_sign_and_more_decimals_can_be_asked_for() -> None:
    assert known(0.184, (0.05, 0.31), most=2, sign="+") == "+0.18"
    assert known_interval((0.05, 0.31), most=2, sign="+") == ["+0.05", "+0.31"]


@given(st.floats(-1e5, 1e5), st.floats(1e-3, 1e5))
def test_rounding_loses_at_most_a_seventh_of_the_half_width(value: float, half: float) -> None:
    interval = value - half, value + half
    places = decimals(interval, most=9)
    assert 10.0**-places <= half / 3.5
    assert abs(round(value, places) - value) <= half / 7


def test_columns_are_as_wide_as_their_widest_cell_and_long_lists_say_how_long() -> None:
    assert aligned([("a", "10"), ("bcd", "2")]) == ["a    10", "bcd   2"]
    assert at_most(2, ["a", "b"]) == ["a", "b"]
    assert at_most(2, ["a", "b", "c"], "the page") == ["a", "... and 2 more: the page"]
