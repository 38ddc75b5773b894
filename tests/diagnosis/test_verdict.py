"""Sentences of a verdict that must not contradict one another."""

from types import SimpleNamespace
from typing import Any

import pytest

from tofcorr.diagnosis.findings.shares import Share
from tofcorr.diagnosis.findings.where import Estimated
from tofcorr.diagnosis.report.words import effect_line, moving_waves, table_of_stages, write_verdict

STUDY: Any = SimpleNamespace(
    fit=SimpleNamespace(model=SimpleNamespace(groups=set())),
    options=SimpleNamespace(target_gap_mm=1.0, tests=SimpleNamespace(named_from=0.5)),
    effects={},
)


def named_of(**changes: Any) -> Any:
    """Return a model in which nothing is named but what is said."""
    known = {"names": (), "sets": {}, "tested": True, "probabilities": {}, "anything": 0.1}
    return SimpleNamespace(study=STUDY, **known | changes)


def verdict_of(
    named: Any,
    size_mm: tuple[float, float, float] = (9.5, 7.0, 12.0),
    shares: dict[str, float] | None = None,
    **remains: Any,
) -> str:
    """Return the verdict of a gap, its interval and its shares."""
    gap_m, *interval = (1e-3 * one for one in size_mm)
    gap = Estimated(gap_m, interval=(interval[0], interval[1]))
    sizes = dict.fromkeys(("before", "after", "whole"), gap)
    noise = {"floor": 2e-3, "floor_from_repeats": True}
    known: Any = SimpleNamespace(as_given=None, **noise, **sizes)
    remainder: Any = SimpleNamespace(**{"unknown": False, "scatter": 0.0} | remains)
    causes = [
        Share(name, "unexplained" if name == "unexplained" else "parameter", share=Estimated(share))
        for name, share in (shares or {"unexplained": 1.0}).items()
    ]
    return write_verdict(named, known, remainder, causes)


@pytest.mark.parametrize(
    ("low", "unknown", "said"),
    [
        (0.0, False, "It may be noise alone."),
        (0.2, False, "That is too small to show a cause."),
        (0.2, True, "None of the effects tested explains it."),
    ],
)
def test_a_gap_without_a_cause_is_unexplained_only_where_something_unknown_was_detected(
    low: float, unknown: bool, said: str
) -> None:
    verdict = verdict_of(named_of(), (0.4, low, 1.4), unknown=unknown)
    assert said in verdict
    assert verdict.count("explains") == unknown
    assert ("No effect is missing" in verdict) is not unknown


@pytest.mark.parametrize(
    ("scatter", "said"),
    [
        (1e-3, "None of the effects tested is probable."),
        (2.5e-3, "Poses of camera or target that scatter by 2.5 mm would explain it."),
    ],
)
def test_a_gap_that_scattering_poses_explain_is_not_called_small(scatter: float, said: str) -> None:
    """2.8 mm of a robot that repeats to 2.5 mm were "too small to show a cause"."""
    assert said in verdict_of(named_of(), (2.8, 2.3, 3.3), scatter=scatter)


def test_a_small_rest_does_not_read_as_nothing() -> None:
    """The page said < 1 % of what the verdict called 0 %."""
    verdict = verdict_of(named_of(), shares={"hand_eye": 0.997, "unexplained": 0.003})
    assert "Shares of its square: hand_eye 100 %; < 1 % is unexplained." in verdict


def test_a_gap_without_a_name_says_how_probable_something_is_and_what_most() -> None:
    verdict = verdict_of(named_of(anything=0.8, probabilities={"warm_up": 0.45, "lens": 0.3}))
    assert "(most probable: warm_up 0.45, lens 0.30)" in verdict
    assert "very probably (probability 0.80) missing: record more poses" in verdict
    assert "missing that this recording could show" not in verdict


def test_an_unknown_cause_is_said_with_the_effects_that_are_nearest() -> None:
    verdict = verdict_of(named_of(probabilities={"lens": 0.2, "any_time": 0.9}), unknown=True)
    assert verdict.endswith("None of the effects tested explains it (most probable: lens 0.20).")


def test_a_cause_says_what_may_be_there_in_its_place() -> None:
    named = named_of(
        names=("warm_up", "lens"),
        sets={"warm_up": {"warm_up": 1.0}, "lens": {"lens": 0.7, "pixel": 0.25}},
        probability_of_any=lambda *names: 0.97 if "lens" in names else 0.6,
    )
    line = effect_line(named, "lens")
    assert "; these data cannot tell it (0.70) from pixel (0.25)" in line
    assert line.endswith("; one of them is almost surely (probability 0.97) there")
    assert effect_line(named, "warm_up").endswith("; it is probably (probability 0.60) there")


@pytest.mark.parametrize("striped", [True, False])
def test_waves_that_move_are_said_to_count_as_noise_in_part(striped: bool) -> None:
    """A user would otherwise look for them in the gap."""
    study: Any = SimpleNamespace(fit=SimpleNamespace(shared=SimpleNamespace(striped=striped)))
    assert ("counts as noise" in moving_waves(study)) == striped


def test_what_is_printed_begins_with_the_gap_at_each_stage() -> None:
    whole, left = (Estimated(own, interval=(own / 2, 2 * own)) for own in (0.0123, 0.0009))
    stages = [
        SimpleNamespace(name=name, gap=gap)
        for name, gap in (("as_given", whole), ("recalibrated", left))
    ]
    gap = SimpleNamespace(floor=0.0025, floor_from_repeats=True)
    result: Any = SimpleNamespace(stages=stages, effects=(), gap=gap)
    assert table_of_stages(result) == [
        "as given           12 mm     [6, 25]",
        "recalibrated      0.9 mm  [0.5, 1.8]",
        "noise of a pixel  2.5 mm",
    ]
