"""Several named effects may be parts of one cause; what a form misses may look like scatter."""

from dataclasses import replace

import pytest
import torch
from diagnosis.comparisons import model_of, side_by_side

from tofcorr.diagnosis.findings.effect_comparison import (
    EffectTest,
    compare_effects,
    fits_too_badly,
    one_cause,
    pose_scatter_squares,
    vary_alike,
)
from tofcorr.diagnosis.findings.naming import causes_of_several, chi_squared, final_sets
from tofcorr.diagnosis.sums.study import Study


def evenly(total: float) -> torch.Tensor:
    """Return a sum over forty poses that is the same in all."""
    return torch.full((40,), total / 40, dtype=torch.float64)


def test_one_cause_need_not_close_significantly_more_than_it_does() -> None:
    base = side_by_side({"lens": 6.0})
    scattered = evenly(10.0) * (1 + 3 * torch.tensor([1.0, -1.0] * 20).double())
    assert one_cause(base, scattered, 0.05) == ["lens"]
    assert one_cause(base, evenly(10.0), 0.05) == []
    assert one_cause(base, 2 * scattered, 0.05) == []  # Less than half of it.


@pytest.mark.parametrize(
    ("together", "expected"),
    [
        (8.9, ["target_shape", "multipath"]),  # A shape explains two thirds of itself,
        (9.1, ["multipath"]),  # multipath half of itself,
        (10.1, []),
        (6.0, ["target_shape", "multipath"]),  # and a fixed pattern is no form of anything.
    ],
)
def test_one_cause_explains_alone_most_of_what_its_parts_explain_together(
    together: float, expected: list[str]
) -> None:
    closes = {"target_shape": 6.0, "fixed_pattern": 6.0, "multipath": 5.0, "lens": 1.0}
    assert one_cause(side_by_side(closes), evenly(together), 0.05) == expected


def test_what_fits_too_badly_is_no_cause_of_several() -> None:
    base = side_by_side({"target_shape": 6.0, "multipath": 5.0})
    found = one_cause(base, evenly(6.0), 0.05, lambda test: test.name == "target_shape")
    assert found == ["multipath"]


def test_a_named_effect_has_in_its_set_those_of_which_it_and_others_may_be_parts(
    nothing_study: Study,
) -> None:
    names = ("robot_kinematics", "target_registration", "incidence_angle")
    found = causes_of_several(model_of(nothing_study, names=names))
    most = compare_effects(nothing_study, names, flips=False, maps=False)
    whole = chi_squared(nothing_study, names)

    def causes(name: str, parts: set[str]) -> set[str]:
        rest = [other for other in names if other not in parts]
        beside = compare_effects(nothing_study, rest, flips=False, maps=False)
        likelihood = chi_squared(nothing_study, rest)

        def excluded(test: EffectTest) -> bool:
            known = sum(beside.tests[part].size for part in parts) <= test.size
            gains = likelihood.closed(test.name), likelihood.squares - whole.squares
            return known and not test.by_tiles and fits_too_badly(test, *gains, 0.05)

        alike = one_cause(beside, beside.squares - most.squares, 0.05, excluded)
        return {cause for cause in alike if vary_alike(cause, name)}

    for name in names:
        pairs = [causes(name, {name, other}) for other in names if other != name]
        assert set(found[name]) == set().union(*pairs) | causes(name, set(names))


def test_gains_of_likelihood_add_up_over_the_poses(nothing_study: Study) -> None:
    """The fall by two effects is that by one, and by the other beside it."""
    models = (), ("lens",), ("lens", "warm_up")
    base, lens, both = (chi_squared(nothing_study, names) for names in models)
    torch.testing.assert_close(base.closed("lens"), base.squares - lens.squares)
    of_both = base.closed("lens") + lens.closed("warm_up")
    torch.testing.assert_close(base.squares - both.squares, of_both)


@pytest.mark.parametrize(("less", "possible"), [(0.9, ("room_temperature", "lens")), (1.2, ())])
def test_what_a_form_misses_may_look_like_scatter_of_the_poses(
    less: float,
    possible: tuple[str, ...],
    nothing_study: Study,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    scatter = pose_scatter_squares(nothing_study)
    others = {"room_temperature": (5 - less) * scatter, "lens": (5 - less) * scatter}
    first = side_by_side({"warm_up": 5 * scatter, **others})
    first = replace(first, squares=0 * first.squares)  # Nothing else is left.
    for test in first.tests.values():
        test.null[:] = -1.0
    monkeypatch.setattr("tofcorr.diagnosis.findings.naming.compare_effects", lambda *_, **__: first)
    found = final_sets(model_of(nothing_study, names=("warm_up",)), [first, first])
    assert tuple(found["warm_up"]) == ("warm_up", *possible)
