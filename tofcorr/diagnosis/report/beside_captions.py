"""The text beside the pictures of noise, missing pixels and amplitude.

The numbers come from the blocks of `diagnosis.json`; one that is missing or null was not compared.
"""

from collections.abc import Mapping, Sequence
from typing import Any

from tofcorr.diagnosis.report.caption import Caption
from tofcorr.diagnosis.report.result import DiagnosisResult
from tofcorr.diagnosis.report.words import p_words
from tofcorr.observables.pose_tests import LEAST_P


def noise(result: DiagnosisResult) -> Caption:
    """Words of the figure of noise."""
    found = result.to_mapping().get("noise")
    finding = "The noise of the recording alone: no simulator states one."
    if found:
        finding = f"Recording {found['real_mm']:.1f} mm, simulator {found['sim_mm']:.1f} mm"
        finding += _ratio(found.get("ratio"), found.get("ratio_ci")) + "." + _explained(found)
    return Caption(
        finding=finding,
        reading="Noise of one pixel, without its fixed pattern, over its brightness. A dot: pixels "
        "of like brightness. Line: the fitted curve." + _source(found) + " The numbers are means "
        "over all pixels; in the noise beside a gap, dark pixels count less.",
        alt="Curves of the noise of a pixel, recording and simulator.",
    )


def dropouts(result: DiagnosisResult) -> Caption:
    """Words of the figure of missing pixels."""
    found = result.to_mapping().get("dropouts")
    finding = "Missing pixels of the recording alone: no simulator states any."
    if found:
        real, sim = 100 * found["real_share"], 100 * found["sim_share"]
        finding = f"Missing: recording {real:.2f} %, simulator {sim:.2f} %"
        finding += _probability(found.get("p_value")) + "." + _explained(found)
    return Caption(
        finding=finding,
        reading="Share of the pixels on the target that have no distance: over their brightness "
        "where it was recorded, without saturated pixels, and over the image." + _saturated(result),
        alt="Curves and maps of the share of missing pixels.",
    )


def amplitude(result: DiagnosisResult) -> Caption:
    """Words of the figure of amplitudes."""
    found = result.to_mapping().get("amplitude")
    finding = "The amplitudes were not compared."
    if found:
        finding = "The recording's amplitude over the simulator's"
        finding += _ratio(found["ratio"], found.get("ratio_ci")) + "." + _explained(found)
    return Caption(
        finding=finding,
        reading="Above: amplitudes of the same pixels; on the thin line both are equal. Below: "
        "their ratio over the image, its mean taken off.",
        alt="Map of recorded against simulated amplitude, and of their ratio over the image.",
    )


def _source(found: Mapping[str, Any] | None) -> str:
    """Return what the noise was measured from."""
    if not found:
        return ""
    if found["source"] == "repeats":
        return " Measured from frames taken without moving."
    return " Measured from differences of neighbouring pixels: too few poses were repeated."


def _ratio(ratio: float | None, interval: Sequence[float] | None) -> str:
    ends = f" [{interval[0]:.2f}, {interval[1]:.2f}]" if interval else ""
    return "" if ratio is None else f": ratio {ratio:.2f}{ends}"


def _probability(p: float | None) -> str:
    return "" if p is None else f" (p {p_words(p, LEAST_P)})"


def _saturated(result: DiagnosisResult) -> str:
    """Return how many of the missing pixels are saturated: the curves leave them out."""
    share = result.observables.real_dropouts.saturated_missing
    return f" Missing because saturated: {100 * share:.2f} % of the recording." if share else ""


def _explained(found: Mapping[str, Any]) -> str:
    """Return what of the camera would explain a difference."""
    causes = found.get("explained_by") or []
    if causes:
        return f" What would explain it: {', '.join(causes)}."
    return " No difference is significant and large enough to report."
