"""The bars of the gap at each stage."""

from types import SimpleNamespace
from typing import Any, cast

import pytest
from matplotlib.text import Text

from tofcorr.diagnosis.findings.where import Estimated, Stage
from tofcorr.diagnosis.report.figures import stage_bars


@pytest.mark.parametrize("floor", [1e-4, 1e-3, 2.9e-3, 3.6e-3, 0.1])
def test_every_word_stands_inside_the_figure_however_large_the_noise_is(floor: float) -> None:
    """The label of a noise beyond the axis was cut at the edge of the picture."""
    stage = Stage(name="recalibrated", gap=Estimated(2.1e-3, interval=(1.4e-3, 2.8e-3)))
    gap, stages = SimpleNamespace(floor=floor), (Stage(name="as_given"), stage)
    known = {"stages": stages, "effects": (), "refined_terms": (), "gap_steps": ()}
    figure = stage_bars(cast("Any", SimpleNamespace(gap=gap, degraded=None, **known)))
    figure.draw_without_rendering()
    for text in figure.findobj(lambda one: isinstance(one, Text) and one.get_text() != ""):
        extent = text.get_window_extent()
        assert extent.x0 >= figure.bbox.x0 - 1, text
        assert extent.x1 <= figure.bbox.x1 + 1, text
