"""Pictures of pages take their colours from the page, and can be told apart without them."""

import re

import numpy as np
from matplotlib import colors

from tofcorr.pages.drawing import BLUE, GREY, LIGHT, PALE, RED, panels, svg_of
from tofcorr.pages.page import resource


def lightness(colour: str) -> float:
    """CIE 1976 lightness, 0 to 100, of a colour in sRGB: what print in grey leaves of it."""
    values = np.array(colors.to_rgb(colour))
    linear = np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)
    luminance = float(linear @ [0.2126, 0.7152, 0.0722])
    return 116 * luminance ** (1 / 3) - 16


def test_colours_differ_in_grey_and_each_can_be_seen_on_white() -> None:
    # Ten units of lightness are told apart in print; an outline needs a contrast of 3 : 1, which
    # is a lightness of 61 on white (WCAG 2.1, 1.4.11).
    assert lightness(RED) - lightness(BLUE) > 10
    assert lightness(PALE) - lightness(BLUE) > 10
    assert max(map(lightness, (RED, BLUE, GREY))) < 61


def test_a_picture_has_no_colour_of_its_own_that_a_dark_page_could_not_change() -> None:
    figure, (axes,) = panels(2)
    for k, colour in enumerate((BLUE, RED, GREY, PALE, LIGHT, "black", "white")):
        axes.plot([0, 1], [k, k], color=colour)
    axes.set_xlabel("words")
    drawn = svg_of(figure)
    assert re.findall(r"#[0-9a-f]{6}\b", drawn) == []
    style = resource("tofcorr.pages", "style.css")
    light, dark = style.split("prefers-color-scheme: dark")
    for name in set(re.findall(r"var\((--\w+)\)", drawn + style)):
        assert f"{name}: #" in light
        assert f"{name}: #" in dark
