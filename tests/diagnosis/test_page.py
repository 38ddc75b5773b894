"""The report page in a browser: no error, nothing cut, a text beside every picture."""

import html
import re
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
from matplotlib.text import Text
from optional import present
from shown_pages import WIDTHS, fetched, looked_at, needs_browser, silent

import tofcorr
from tofcorr.diagnosis.findings.shares import Share
from tofcorr.diagnosis.findings.where import Estimated, Stage
from tofcorr.diagnosis.report.figures import all_figures, stage_bars
from tofcorr.diagnosis.report.result import DiagnosisResult, render
from tofcorr.diagnosis.report.words import (
    along,
    cause_words,
    effect_words,
    interval_words,
    p_words,
    share_words,
)
from tofcorr.diagnosis.rerun.simulator import sensor_of


def with_simulator(result: DiagnosisResult) -> DiagnosisResult:
    """The same findings as if a simulator had been given, with many causes of long names."""
    _, second, third = result.stages
    given = Estimated(0.0336, interval=(0.0321, 0.0349))
    first = replace(second, name="as_given", gap=given)
    names = ("distance", "row_column_pattern", "target_registration", "hand_eye", "pixel")
    shares = (1.2, 0.1, -0.2, -0.15, 0.04)
    known = [
        Share(name, "parameter", share=Estimated(share, interval=(share - 0.1, share + 0.2)))
        for name, share in zip(names, shares, strict=True)
    ]
    share = Estimated(0.01, interval=(0.0, 0.02))
    left = Share("unexplained", "unexplained", share=share)
    return replace(result, stages=(first, second, third), shares=(*known, left))


def without_effects(result: DiagnosisResult) -> DiagnosisResult:
    """The same findings as if nothing had been named."""
    left = Share("unexplained", "unexplained", share=Estimated(1.0, interval=(0.9, 1.0)))
    return replace(result, effects=(), cause_sets=(), gap_steps=(), shares=(left,))


Kind = Callable[[DiagnosisResult], DiagnosisResult]


@pytest.fixture(scope="module")
def rendered(time_diagnosis: DiagnosisResult) -> Callable[[Kind], str]:
    """The page of each kind of findings, rendered once."""
    return cache(lambda kind: render(kind(time_diagnosis)))


@needs_browser
@pytest.mark.parametrize("kind", [with_simulator, without_effects])
def test_nothing_of_the_page_is_cut_and_every_picture_has_a_text_beside_it(
    kind: Kind, rendered: Callable[[Kind], str], time_diagnosis: DiagnosisResult, tmp_path: Path
) -> None:
    frames, console = looked_at(rendered(kind), tmp_path)
    assert console == ""
    for width, seen in zip(WIDTHS, frames, strict=True):
        assert seen["width"] == width
        assert seen["scroll"] <= width
        assert seen["cut"] == []
        assert seen["silent"] == []
        assert seen["pictures"] == len(all_figures(kind(time_diagnosis)))


@needs_browser
def test_the_browser_would_see_what_is_cut_silent_or_wrong(page: str, tmp_path: Path) -> None:
    wide = '<pre style="width:700px">wide</pre><script>console.error("odd"); odd()</script>'
    spoilt = page.replace("</h1>", f"</h1>{wide}").replace("<figcaption>", "<div>", 1)
    (_, narrow), console = looked_at(spoilt, tmp_path)
    assert narrow["scroll"] > 480
    assert any(text.startswith("PRE") for text in narrow["cut"])
    assert len(narrow["silent"]) == 1
    assert "odd" in console
    assert "not defined" in console


def test_every_picture_of_every_kind_of_report_has_words(
    rendered: Callable[[Kind], str], page: str, time_diagnosis: DiagnosisResult
) -> None:
    kinds = [(kind(time_diagnosis), rendered(kind)) for kind in (with_simulator, without_effects)]
    for result, whole in (*kinds, (time_diagnosis, page)):
        assert (fetched(whole), silent(whole)) == ([], 0)
        # The version of the file of numbers stood there.
        assert f"<footer>tofcorr {tofcorr.__version__}</footer>" in whole
        figures, shown = all_figures(result), html.unescape(whole)
        assert ("where_as_given" in figures) == (result.stages[0].gap is not None)
        for name in figures:
            figure = shown[shown.index(f'<figure id="{name}">') :].split("</figure>")[0]
            alt, finding, reading = (
                re.search(pattern, figure, re.DOTALL)
                for pattern in ('label="([^"]*)"', "<p><b>(.*?)</b></p>", "</b></p><p>(.*)</p>")
            )
            for words in (alt, finding, reading):
                assert re.fullmatch(r"[A-Z].*\.", present(words)[1], re.DOTALL)


def test_the_first_strip_is_what_the_text_beside_it_names(time_diagnosis: DiagnosisResult) -> None:
    # Of several biases at the least p-value the text named the largest, often a straight line over
    # a few far pixels: "distance: it changes by -5.1 mm" beside a strip from 0.5 to -1.1 mm.
    where = time_diagnosis.stages[1]
    times = [one for one in where.regions if one.covariate == "integration_time"]
    bins = [replace(one, p_value=0.003) for one in times if not one.trend]
    one = Estimated(1.0)
    line = replace(times[0], covariate="distance_m", trend=True, bias=one, p_value=0.003)
    covariate, ends, _, significant = along(replace(where, regions=(line, *bins)))
    low, high = (1e3 * pick(one.bias for one in bins) for pick in (min, max))
    assert significant
    assert (covariate, ends) == ("integration time", f"from {low:.1f} to {high:.1f} mm")


def test_the_verdict_comes_before_the_causes(page: str, time_diagnosis: DiagnosisResult) -> None:
    places = [page.index('class="verdict'), page.index("<h2"), page.index("<svg")]
    assert places == sorted(places)
    assert html.unescape(page).index(time_diagnosis.causes[0]) < places[1]


def test_what_is_compared_beside_the_gap_is_told_in_figures(
    time_diagnosis: DiagnosisResult, monkeypatch: pytest.MonkeyPatch
) -> None:
    ratio = {"ratio": 3.1, "ratio_ci": [2.9, 3.3], "source": "repeats"}
    noise = {"real_mm": 3.1, "sim_mm": 1.0, **ratio, "explained_by": []}
    lost = {"real_share": 0.021, "sim_share": 0.0, "p_value": 0.003, "explained_by": []}
    found = time_diagnosis.to_mapping() | {"noise": noise, "dropouts": lost}
    monkeypatch.setattr(DiagnosisResult, "to_mapping", lambda _: found)
    shown = html.unescape(render(time_diagnosis))
    assert "3.1 mm, simulator 1.0 mm: ratio 3.10 [2.90, 3.30]. No difference" in shown
    assert "recording 2.10 %, simulator 0.00 % (p = 0.003)." in shown
    assert shown.index("Noise, missing pixels, amplitude") < shown.index('<figure id="noise">')


def test_a_p_value_at_the_least_that_flips_can_give_says_at_most() -> None:
    assert p_words(1 / 300, 1 / 300) == "≤ 0.003"
    assert p_words(0.0066, 1 / 300) == "= 0.007"


def test_the_interval_of_a_share_that_is_not_determined_is_cut_off() -> None:
    assert interval_words((-0.126, 0.934)) == "[-13 %, 93 %]"
    assert interval_words((-28.07, 2.37)) == "[< -100 %, > 200 %]"
    assert interval_words((-1.0, 2.0)) == "[-100 %, 200 %]"


def test_base_terms_and_higher_orders_have_their_own_names(time_diagnosis: DiagnosisResult) -> None:
    study = time_diagnosis.evidence.study
    assert effect_words(study, "distance") == "distance (higher order)"
    assert effect_words(study, "wiggling") == "wiggling"
    assert cause_words(study, Share("distance", "parameter")) == "distance (base term)"
    assert share_words(0.0004) == "< 1 %"


def test_every_fitted_value_stands_on_the_page_as_in_the_sensor_file(
    page: str, time_diagnosis: DiagnosisResult
) -> None:
    sensor = sensor_of(time_diagnosis.evidence, None)
    found = {(one.cause, one.name): one for one in time_diagnosis.fitted}
    for group, values in sensor.error.coefficients.items():
        for name, value in values.items():
            assert found[group, name].value == pytest.approx(value, rel=1e-9, abs=1e-12)
    (effect,) = sensor.effects
    for name in ("log_1", "log_2"):
        one = found["integration_time", name]
        assert one.value == pytest.approx(effect[name], rel=1e-6)
        low, high = present(one.interval)
        assert low <= one.value <= high
        assert f">{name}</td>" in page


@pytest.mark.parametrize("floor", [1e-4, 1e-3, 2.9e-3, 3.6e-3, 0.1])
def test_every_word_stands_inside_the_figure_however_large_the_noise_is(floor: float) -> None:
    """The label of a noise beyond the axis was cut at the edge of the picture."""
    stage = Stage(name="recalibrated", gap=Estimated(2.1e-3, interval=(1.4e-3, 2.8e-3)))
    gap, stages = SimpleNamespace(floor=floor), (Stage(name="as_given"), stage)
    known = {"stages": stages, "effects": (), "gap_steps": ()}
    figure = stage_bars(cast("Any", SimpleNamespace(gap=gap, degraded=None, **known)))
    figure.draw_without_rendering()
    for text in figure.findobj(lambda one: isinstance(one, Text) and one.get_text() != ""):
        extent = text.get_window_extent()
        assert extent.x0 >= figure.bbox.x0 - 1, text
        assert extent.x1 <= figure.bbox.x1 + 1, text
