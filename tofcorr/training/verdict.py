"""The verdict of a run: good, usable, or do not use; and why, in one sentence."""

from collections.abc import Mapping, Sequence
from typing import Any, Literal

from tofcorr.fit.result import Fit
from tofcorr.plausibility.inspection import Inspection
from tofcorr.training.evidence import Evidence, Rule
from tofcorr.training.refusals import REFUSALS
from tofcorr.training.reservations import RESERVATIONS, WEAK
from tofcorr.training.support import Support

Verdict = Literal["good", "usable", "do not use"]
DO_NOT_USE: Verdict = "do not use"


def judge(
    fit: Fit, errors: Mapping[str, Any], support: Support, inspection: Inspection
) -> tuple[Verdict, str]:
    """Return the verdict and its reason.

    Args:
        fit: The fitted model.
        errors: The `error_mm` of the report.
        support: What the fitted frames cover.
        inspection: What was odd about the recordings; its noise of a pixel is the floor.
    """
    after = errors["after"]
    evidence = Evidence(
        fit=fit,
        support=support,
        inspection=inspection,
        held_out=after["test"]["rms"],
        fitted=after["train"]["rms"] or 0.0,
        bare=errors["hand_eye_only"]["test"]["rms"],
        noise=1e3 * inspection.look.sample.noise,
        noise_rms=1e3 * inspection.look.sample.noise_rms,
    )
    judged: tuple[tuple[Verdict, Sequence[Rule]], ...]
    judged = ((DO_NOT_USE, REFUSALS), ("usable", RESERVATIONS))
    for verdict, rules in judged:
        for rule in rules:
            reason = rule(evidence)
            if reason is not None:
                return verdict, reason
    return "good", f"{evidence.measured()}, and {_determined(fit)}."


def _determined(fit: Fit) -> str:
    """Return what is known to the accuracy of a good run; some coefficients may not be."""
    if all(one.sigma <= WEAK for one in fit.observability.directions):
        return "every direction is determined"
    return f"the hand-eye transform is determined to {1e3 * WEAK:g} mm and mrad"
