"""Sentences of a verdict that must not contradict one another."""

import math
from types import SimpleNamespace
from typing import Any

import pytest

from tofcorr.diagnosis.findings.shares import Share
from tofcorr.diagnosis.findings.where import Estimated
from tofcorr.diagnosis.report.words import effect_line, moving_waves, write_verdict

NOTHING_NAMED: Any = SimpleNamespace(
    names=(),
    tested=True,
    likeliest=(),
    study=SimpleNamespace(options=SimpleNamespace(target_gap_mm=1.0)),
)
ALL_UNEXPLAINED = [Share("unexplained", "unexplained", share=Estimated(1.0))]


def gap_of(
    size: float, interval: tuple[float, float], floor: float, *, from_repeats: bool = True
) -> Any:
    """Return a gap that no effect closes, metres."""
    known = Estimated(size, interval=interval)
    sizes = dict.fromkeys(("before", "after", "whole"), known)
    return SimpleNamespace(as_given=None, floor=floor, floor_from_repeats=from_repeats, **sizes)


LARGE_GAP = gap_of(9.5e-3, (7e-3, 12e-3), 2e-3)


@pytest.mark.parametrize("certain", [False, True])
def test_a_name_on_less_evidence_is_said_to_be_one(certain: bool) -> None:
    named: Any = SimpleNamespace(
        names=("warm_up",),
        sets={"warm_up": {"warm_up": 1.0}},
        certain=certain,
        study=SimpleNamespace(fit=SimpleNamespace(model=SimpleNamespace(groups=frozenset()))),
    )
    remainder: Any = SimpleNamespace(unknown=False, scatter=0.0)
    verdict = write_verdict(named, LARGE_GAP, remainder, ALL_UNEXPLAINED)
    assert verdict.endswith("More poses would decide.") == certain


@pytest.mark.parametrize(
    ("low", "unknown", "said"),
    [
        (0.0, False, "Noise may be all of it."),
        (2e-4, False, "That is too small to show a cause."),
        (2e-4, True, "None of the effects tested explains it."),
    ],
)
def test_a_gap_without_a_cause_is_unexplained_only_where_something_unknown_was_detected(
    low: float, unknown: bool, said: str
) -> None:
    gap = gap_of(4e-4, (low, 14e-4), 28e-4)
    remainder: Any = SimpleNamespace(unknown=unknown, scatter=0.0)
    verdict = write_verdict(NOTHING_NAMED, gap, remainder, ALL_UNEXPLAINED)
    assert said in verdict
    assert verdict.count("explains") == unknown
    assert ("No effect is missing" in verdict) is not unknown


def test_a_gap_that_scattering_poses_explain_is_not_called_small() -> None:
    """2.8 mm of a robot that repeats to 2.5 mm were "too small to show a cause"."""
    gap = gap_of(2.8e-3, (2.3e-3, 3.3e-3), 3.5e-3, from_repeats=False)
    still: Any = SimpleNamespace(unknown=False, scatter=1e-3)
    verdict = write_verdict(NOTHING_NAMED, gap, still, ALL_UNEXPLAINED)
    assert "None of the effects tested is significant." in verdict
    remainder: Any = SimpleNamespace(unknown=False, scatter=2.5e-3)
    verdict = write_verdict(NOTHING_NAMED, gap, remainder, ALL_UNEXPLAINED)
    assert "Poses of camera or target that scatter by 2.5 mm would explain it." in verdict


def test_a_small_rest_does_not_read_as_nothing() -> None:
    """The page said < 1 % of what the verdict called 0 %."""
    left = Share("unexplained", "unexplained", share=Estimated(0.003))
    cause = Share("hand_eye", "parameter", share=Estimated(0.997))
    remainder: Any = SimpleNamespace(unknown=False, scatter=0.0)
    verdict = write_verdict(NOTHING_NAMED, LARGE_GAP, remainder, [cause, left])
    assert "Shares of its square: hand_eye 100 %; < 1 % is unexplained." in verdict


KNOWN: Any = SimpleNamespace(unknown=False, scatter=0.0)
UNKNOWN: Any = SimpleNamespace(unknown=True, scatter=0.0)
STUDY: Any = SimpleNamespace(
    fit=SimpleNamespace(model=SimpleNamespace(groups=set())), options=NOTHING_NAMED.study.options
)


def test_a_large_gap_without_a_significant_cause_names_the_likeliest_ones() -> None:
    named: Any = SimpleNamespace(names=(), tested=True, likeliest=("warm_up", "lens"), study=STUDY)
    verdict = write_verdict(named, LARGE_GAP, KNOWN, ALL_UNEXPLAINED)
    assert "(likeliest, but not significant: warm_up, lens)" in verdict
    assert "record more poses" in verdict
    assert "missing that this recording could show" not in verdict


def test_an_unknown_cause_is_said_with_the_effects_that_are_nearest() -> None:
    named: Any = SimpleNamespace(names=(), tested=True, likeliest=("lens",), study=STUDY)
    verdict = write_verdict(named, LARGE_GAP, UNKNOWN, ALL_UNEXPLAINED)
    assert verdict.endswith("None of the effects tested explains it (nearest: lens).")


@pytest.mark.parametrize(
    ("sets", "said"),
    [
        ((("warm_up",), ("lens",)), "With warm_up and lens added"),
        ((("warm_up",), ("lens", "pixel")), "With warm_up and lens added"),
        ((("warm_up",), ("lens", "warm_up")), "(or only warm_up, of another form) added"),
        ((("warm_up", "lens"), ("lens", "warm_up")), "(or only warm_up or lens, of another form)"),
    ],
)
def test_named_effects_that_may_be_one_are_said_to(
    sets: tuple[tuple[str, ...], ...], said: str
) -> None:
    named: Any = SimpleNamespace(
        names=("warm_up", "lens"),
        certain=False,
        sets={each[0]: dict.fromkeys(each, 0.0) for each in sets},
        likeliest=(),
        study=STUDY,
    )
    assert said in write_verdict(named, LARGE_GAP, KNOWN, ALL_UNEXPLAINED)


def test_a_cause_says_what_it_may_be_instead_and_an_error_in_the_form_of() -> None:
    named: Any = SimpleNamespace(
        names=("warm_up", "room_temperature"),
        certain=False,
        sets={
            "warm_up": {"warm_up": 1.0},
            "room_temperature": {"room_temperature": 1.0, "lens": 0.5, "warm_up": math.nan},
        },
        study=SimpleNamespace(fit=STUDY.fit, candidates=SimpleNamespace(effects={})),
    )
    line = effect_line(named, "room_temperature")
    assert "which these data cannot distinguish from lens (closes 50 % of what" in line
    assert line.endswith("; it may be an error in the form of warm_up")
    assert "error in the form" not in effect_line(named, "warm_up")


def test_waves_that_move_are_said_to_count_as_noise_in_part() -> None:
    """A user would otherwise look for them in the gap."""

    def remark(*, striped: bool) -> str:
        study: Any = SimpleNamespace(fit=SimpleNamespace(shared=SimpleNamespace(striped=striped)))
        return moving_waves(study)

    assert "counts as noise" in remark(striped=True)
    assert not remark(striped=False)
