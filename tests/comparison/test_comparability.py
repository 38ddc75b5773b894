"""What a reader is told before models that were fitted differently are compared."""

from typing import Any

import pytest

from tofcorr.comparison.options import EvaluationOptions, comparability_notes

TERMS = {"terms": [{"kind": "distance_polynomial", "degree": 1}]}


def notes(*models: dict[str, Any], **common: Any) -> list[str]:
    named = [{"name": f"M{k}", "model": TERMS} | one for k, one in enumerate(models)]
    return comparability_notes(EvaluationOptions.from_mapping({"models": named} | common, "test"))


def test_models_that_differ_in_their_terms_alone_need_no_note() -> None:
    assert notes({}, {"model": {"terms": []}}) == []
    assert notes({}, {}, edge_contrast=2.0, grazing_deg=50.0) == []


@pytest.mark.parametrize(
    ("model", "sentence"),
    [
        ({"weights": {"noise": True}}, "with pixels weighted by their noise."),
        ({"weights": {"robust": "huber"}}, "with robust weights (huber)."),
        ({"planes": "unknown"}, "with estimated walls."),
        (
            {"outlier_window_mm": 15.0, "weights": {"noise": True, "robust": "cauchy"}},
            "to other pixels than those measured (the recording's mask, outlier_window_mm: 15.0), "
            "with pixels weighted by their noise, with robust weights (cauchy).",
        ),
    ],
)
def test_the_model_that_was_fitted_differently_is_named_with_all_that_differs(
    model: dict[str, Any], sentence: str
) -> None:
    said, measured = notes({}, model)
    assert said == f"M1 was fitted {sentence}"
    assert measured.startswith("All models are measured on the same held-out pixels")


def test_the_pixels_measured_are_said_mask_by_mask() -> None:
    masks = {"mask": "ransac", "mask_tolerance_mm": 20.0, "edge_contrast": 2.0, "grazing_deg": 40.0}
    *_, measured = notes({"weights": {"noise": True}}, **masks, planes="known")
    assert (
        "(the recording's mask, edge_contrast: 2.0, grazing_deg: 40.0, mask: ransac, "
        "mask_tolerance_mm: 20.0)" in measured
    )
    assert measured.endswith("against the recorded planes.")
