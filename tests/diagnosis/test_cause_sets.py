"""What a named effect may be instead: other forms of it, or one cause of several."""

from dataclasses import replace

import pytest
import torch
from diagnosis.comparisons import effect_test, model_of, side_by_side

from tofcorr.diagnosis.findings.effect_comparison import (
    EffectComparison,
    EffectTest,
    cause_set,
    comparable,
    compare_effects,
    fits_too_badly,
    one_cause,
    pose_scatter_squares,
    unexplained_squares,
    vary_alike,
)
from tofcorr.diagnosis.findings.naming import (
    causes_of_several,
    chi_squared,
    final_sets,
    least_closed,
    likeliest,
    next_effect,
    own_set,
)
from tofcorr.diagnosis.sums.study import Study


def test_what_closes_less_by_no_more_than_is_left_unexplained_is_not_excluded() -> None:
    compared = side_by_side({"target_shape": 8.0, "multipath": 6.0, "lens": 5.0})
    assert cause_set(compared, "target_shape", 0.05, 0.9, missed=1.9) == ["target_shape"]
    assert cause_set(compared, "target_shape", 0.05, 0.9, missed=2.1) == [
        "target_shape",
        "multipath",
    ]
    assert "lens" not in cause_set(compared, "target_shape", 0.05, 0.9, missed=9.0)


@pytest.mark.parametrize(
    ("unexplained", "expected"),
    [(8.0, []), (24.0, ["multipath"]), (72.0, ["multipath", "lens"])],
)
def test_what_explains_the_smaller_part_says_little_of_the_cause(
    unexplained: float, expected: list[str]
) -> None:
    """With 24 of 32 unexplained the named effect explains a quarter: a third of it is enough."""
    compared = side_by_side({"target_shape": 8.0, "multipath": 2.7, "lens": 1.2, "pixel": 0.9})
    found = cause_set(compared, "target_shape", 0.05, 0.9, missed=9.0, unexplained=unexplained)
    assert found == ["target_shape", *expected]


def test_an_effect_that_is_more_likely_than_the_named_one_is_not_excluded() -> None:
    compared = side_by_side({"target_shape": 8.0, "lens": 1.0})
    likely = replace(compared.tests["lens"], gain=9.0)
    compared = replace(compared, tests=compared.tests | {"lens": likely})
    assert cause_set(compared, "target_shape", 0.05, 0.9) == ["target_shape", "lens"]


@pytest.mark.parametrize(
    ("gain", "expected"),
    [(6.0, ["lens", "pixel"]), (5.2, ["lens"]), (9.0, ["lens", "pixel"]), (0.1, ["lens"])],
)
def test_what_fits_worse_than_any_error_in_its_form_is_excluded_whatever_it_closes(
    gain: float, expected: list[str]
) -> None:
    """The form of `pixel` misses a third at most: of a gain of 8 its columns explain 5.4."""
    compared = side_by_side({"lens": 8.0, "pixel": 7.9})
    each = torch.ones(40, dtype=torch.float64) / 40
    gains = {"lens": 8.0 * each, "pixel": gain * each}
    test = replace(compared.tests["pixel"], gain=gain)
    compared = replace(compared, tests=compared.tests | {"pixel": test})
    found = cause_set(compared, "lens", 0.05, 0.9, gains=gains.__getitem__)
    assert found == expected
    assert cause_set(compared, "lens", 0.05, 0.9) == ["lens", "pixel"]


def test_gains_that_differ_from_pose_to_pose_exclude_nothing() -> None:
    compared = side_by_side({"lens": 8.0, "pixel": 7.9})
    each = torch.ones(40, dtype=torch.float64) / 40
    gains = {"lens": 8.0 * each, "pixel": 3.0 * each}
    of_one_pose = torch.zeros(40, dtype=torch.float64)
    of_one_pose[7] = 8.0
    test = replace(compared.tests["pixel"], gain=3.0)
    compared = replace(compared, tests=compared.tests | {"pixel": test})
    assert cause_set(compared, "lens", 0.05, 0.9, gains=gains.__getitem__) == ["lens"]
    gains["lens"] = of_one_pose
    assert cause_set(compared, "lens", 0.05, 0.9, gains=gains.__getitem__) == ["lens", "pixel"]


@pytest.mark.parametrize(
    ("test", "named", "expected"),
    [
        ("pixel", {"lens": 5}, True),
        ("pixel", {"lens": 6}, False),  # More columns than the five of `pixel`.
        ("pixel", {"lens": 3, "multipath": 2}, True),
        ("pixel", {"lens": 3, "multipath": 3}, False),
        ("fixed_pattern", {"lens": 5}, False),  # A map is not compared pose by pose.
        ("pixel", {"fixed_pattern": 5}, False),
    ],
)
def test_what_is_named_excludes_by_likelihood_what_is_no_simpler(
    test: str, named: dict[str, int], expected: bool
) -> None:
    compared = side_by_side(dict.fromkeys((test, *named), 1.0))
    known = [replace(compared.tests[name], size=size) for name, size in named.items()]
    assert comparable(compared.tests[test], *known) == expected


def test_wiggling_may_be_all_that_the_distance_shows_named_or_not(nothing_study: Study) -> None:
    first = side_by_side({"distance": 8.0, "wiggling": 0.5})
    last = replace(first, squares=0 * first.squares)
    alone = own_set(model_of(nothing_study, names=("distance",)), "distance", first, last)
    both = model_of(nothing_study, names=("distance", "wiggling"))
    beside = side_by_side({"distance": 8.0}, chosen=("wiggling",))
    assert alone == own_set(both, "distance", beside, last) == ["wiggling"]


def test_a_set_holds_what_is_significant_beside_a_model_and_says_what_each_closes(
    nothing_study: Study,
) -> None:
    """The gain is what an effect closes here; by chance it is at most one."""
    before = side_by_side({"fixed_pattern": 8.0, "lens": 6.0, "pixel": 0.9, "multipath": 0.5})
    after = side_by_side({"lens": 0.5, "pixel": 0.5, "multipath": 1.5}, chosen=("fixed_pattern",))
    maps = {"fixed_pattern": ["fixed_pattern", "lens", "pixel", "multipath", "ambient_light"]}
    model = model_of(nothing_study, names=("fixed_pattern",), map_sets=maps)
    found = final_sets(model, [before, after])["fixed_pattern"]
    assert found == pytest.approx({"fixed_pattern": 1.0, "lens": 0.75, "multipath": 0.0625})


@pytest.mark.parametrize(
    ("one", "other", "alike"),
    [
        ("lens", "multipath", True),
        ("warm_up", "multipath", False),
        ("robot_kinematics", "room_temperature", True),
        ("warm_up", "target_registration", True),
        ("robot_kinematics", "motion", False),
    ],
)
def test_what_displaces_the_camera_varies_like_what_shifts_whole_images(
    one: str, other: str, alike: bool
) -> None:
    assert vary_alike(one, other) == vary_alike(other, one) == alike


def test_the_likeliest_causes_are_large_and_significant_but_for_their_number(
    nothing_study: Study,
) -> None:
    square = nothing_study.system.sums.count * 1e-6
    gains = {
        "lens": (4.0, 1.2),
        "pixel": (9.0, 0.8),
        "warm_up": (1.1, 3.0),
        "amplitude": (0.5, 9.0),
    }
    tests = {
        name: effect_test(name, closes * square, gain=gain)
        for name, (closes, gain) in gains.items()
    }
    last = EffectComparison(chosen=(), squares=20 * square, tests=tests, probes={})
    assert likeliest(nothing_study, last) == ("warm_up", "lens")


def test_noise_and_scatter_of_the_poses_are_not_unexplained(nothing_study: Study) -> None:
    """With nothing missing, less is left than a third of a millimetre, root mean square."""
    comparison = compare_effects(nothing_study, (), flips=False)
    count = float(nothing_study.system.sums.count.sum())
    left = unexplained_squares(nothing_study, comparison) / count
    assert left < (0.35e-3) ** 2
    one = nothing_study.system.sums.count * 1e-6  # A square millimetre in every pixel.
    ten, twenty = (
        unexplained_squares(
            nothing_study, replace(comparison, squares=comparison.squares + many * one)
        )
        for many in (10, 20)
    )
    assert (twenty - ten) / count == pytest.approx(10e-6)
    larger = replace(comparison, squares=comparison.squares + 10 * one)
    least = unexplained_squares(nothing_study, larger, at_least=True)
    fit = nothing_study.fit
    assert (ten - least) / count == pytest.approx(fit.floor**2 * ((1.05 * fit.noise.most) ** 2 - 1))


@pytest.mark.parametrize(
    ("gain", "left_mm2", "named"), [(4.0, 5.0, True), (4.0, 100.0, False), (90.0, 100.0, True)]
)
def test_a_weak_effect_beside_much_that_stays_unexplained_is_not_named(
    gain: float, left_mm2: float, named: bool, nothing_study: Study
) -> None:
    """It closes five square millimetres: more, or less, than a tenth of what then is left."""
    square = 1e-6 * nothing_study.system.sums.count
    noise = nothing_study.fit.floor**2 * nothing_study.system.sums.count
    lens = effect_test("lens", 5 * square, gain=gain)
    compared = EffectComparison(
        chosen=(), squares=noise + (5 + left_mm2) * square, tests={"lens": lens}, probes={}
    )
    found = next_effect(model_of(nothing_study, compared))
    assert (found is not None) == named


def test_beside_an_effect_that_varies_alike_more_must_close_than_its_form_misses(
    nothing_study: Study,
) -> None:
    tests, gap = nothing_study.options.tests, 1e-4  # Ten millimetres, squared.
    squares = (gap + nothing_study.fit.floor**2) * nothing_study.sums.count
    compared = EffectComparison(chosen=(), squares=squares, tests={}, probes={})
    model = model_of(nothing_study, compared, names=("multipath", "motion"))
    assert least_closed(model, "target_shape") == pytest.approx(gap / 16)
    for name in ("multipath", "warm_up"):
        assert least_closed(model, name) == pytest.approx((tests.further_mm * 1e-3) ** 2)
    first = least_closed(replace(model, names=()), "warm_up")
    assert first == pytest.approx(gap * tests.material_share)


@pytest.mark.parametrize(
    ("probe", "name", "closes", "named"),
    [
        ("frame_period", "lens", 5.9, False),
        ("frame_period", "lens", 6.1, True),
        ("frame_period", "fixed_pattern", 5.9, False),
        ("image_shape", "lens", 5.9, False),
        ("image_shape", "fixed_pattern", 5.9, True),  # One shape in every image is such a pattern.
    ],
)
def test_what_an_effect_closes_beside_a_probe_may_be_a_form_of_the_unknown_cause(
    probe: str,
    name: str,
    closes: float,
    named: bool,
    nothing_study: Study,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(
        "tofcorr.diagnosis.findings.naming.held_out_squares",
        lambda _, names: torch.tensor([4.0 if probe in names else 10.0]),
    )
    compared = side_by_side({name: closes}, chosen=(probe,))
    found = next_effect(model_of(nothing_study, compared, probes={probe: 0.01}))
    assert (found is not None) == named


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
