"""Sentences of a verdict that must not contradict one another."""

import math
from types import SimpleNamespace
from typing import Any

import pytest

from tofcorr.diagnosis.findings.shares import Share
from tofcorr.diagnosis.findings.where import Estimated
from tofcorr.diagnosis.report.words import effect_line, moving_waves, write_verdict

STUDY: Any = SimpleNamespace(
    fit=SimpleNamespace(model=SimpleNamespace(groups=set())),
    options=SimpleNamespace(target_gap_mm=1.0),
    candidates=SimpleNamespace(effects={}),
)


def named_of(**changes: Any) -> Any:
    """Return a model in which nothing is named but what is said."""
    known = {"names": (), "sets": {}, "tested": True, "likeliest": (), "certain": False}
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


@pytest.mark.parametrize("certain", [False, True])
def test_a_name_on_less_evidence_is_said_to_be_one(certain: bool) -> None:
    named = named_of(names=("warm_up",), sets={"warm_up": {"warm_up": 1.0}}, certain=certain)
    assert verdict_of(named).endswith("More poses would decide.") == certain


@pytest.mark.parametrize(
    ("low", "unknown", "said"),
    [
        (0.0, False, "Noise may be all of it."),
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
        (1e-3, "None of the effects tested is significant."),
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


def test_a_large_gap_without_a_significant_cause_names_the_likeliest_ones() -> None:
    verdict = verdict_of(named_of(likeliest=("warm_up", "lens")))
    assert "(likeliest, but not significant: warm_up, lens)" in verdict
    assert "record more poses" in verdict
    assert "missing that this recording could show" not in verdict


def test_an_unknown_cause_is_said_with_the_effects_that_are_nearest() -> None:
    verdict = verdict_of(named_of(likeliest=("lens",)), unknown=True)
    assert verdict.endswith("None of the effects tested explains it (nearest: lens).")


@pytest.mark.parametrize(
    ("sets", "said"),
    [
        ((("warm_up",), ("lens", "pixel")), "With warm_up and lens added"),
        ((("warm_up",), ("lens", "warm_up")), "(or only warm_up, of another form) added"),
        ((("warm_up", "lens"), ("lens", "warm_up")), "(or only warm_up or lens, of another form)"),
    ],
)
def test_named_effects_that_may_be_one_are_said_to(
    sets: tuple[tuple[str, ...], ...], said: str
) -> None:
    known = {each[0]: dict.fromkeys(each, 0.0) for each in sets}
    assert said in verdict_of(named_of(names=("warm_up", "lens"), sets=known))


def test_a_cause_says_what_it_may_be_instead_and_an_error_in_the_form_of() -> None:
    own = {"room_temperature": 1.0, "lens": 0.5, "warm_up": math.nan}
    sets = {"warm_up": {"warm_up": 1.0}, "room_temperature": own}
    named = named_of(names=("warm_up", "room_temperature"), sets=sets)
    line = effect_line(named, "room_temperature")
    assert "which these data cannot distinguish from lens (closes 50 % of what" in line
    assert line.endswith("; it may be an error in the form of warm_up")
    assert "error in the form" not in effect_line(named, "warm_up")


@pytest.mark.parametrize("striped", [True, False])
def test_waves_that_move_are_said_to_count_as_noise_in_part(striped: bool) -> None:
    """A user would otherwise look for them in the gap."""
    study: Any = SimpleNamespace(fit=SimpleNamespace(shared=SimpleNamespace(striped=striped)))
    assert ("counts as noise" in moving_waves(study)) == striped
