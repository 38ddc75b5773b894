"""What scatter of the poses hides, and what stays significant, widens a set."""

import pytest
from diagnosis.comparisons import side_by_side

from tofcorr.diagnosis.findings.final_sets import _own_set
from tofcorr.diagnosis.findings.form_error import pose_scatter_squares, still_significant
from tofcorr.diagnosis.findings.naming import _Model
from tofcorr.diagnosis.sums.study import Study


def test_what_a_named_effect_leaves_significant_may_be_the_cause() -> None:
    first = side_by_side({"mixed_pixels": 8.0, "saturation": 4.5, "lens": 3.0, "warm_up": 6.0})
    last = side_by_side({"saturation": 1.5, "lens": 2.0, "warm_up": 2.0}, chosen=("mixed_pixels",))
    # A lens closes too little, and warm-up shifts whole images.
    assert still_significant(first, last, "mixed_pixels", 0.05, 1.4) == ["saturation"]
    assert still_significant(first, last, "mixed_pixels", 0.05, 1.6) == []
    gone = side_by_side({"saturation": 0.5, "lens": 2.0}, chosen=("mixed_pixels",))
    assert still_significant(first, gone, "mixed_pixels", 0.05, 0.0) == []


@pytest.mark.parametrize(("less", "possible"), [(0.9, ["room_temperature"]), (1.2, [])])
def test_what_the_form_of_a_shift_of_images_misses_looks_like_scatter_of_the_poses(
    nothing_study: Study, less: float, possible: list[str]
) -> None:
    scatter = pose_scatter_squares(nothing_study)
    others = {"room_temperature": (5 - less) * scatter, "lens": (5 - less) * scatter}
    first = side_by_side({"warm_up": 5 * scatter, **others})
    model = _Model(nothing_study, names=["warm_up"])
    assert _own_set(model, "warm_up", first, 0.0) == possible
