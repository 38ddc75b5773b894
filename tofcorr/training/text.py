"""A training's report as text for a terminal."""

from collections.abc import Mapping
from typing import Any

from tofcorr.training.hand_eye import assumptions_text, hand_eye_text, noise_shift_text

# Warnings printed; the rest is in report.json. Chosen: more are not read.
_MOST_WARNINGS = 5


def report_text(report: Mapping[str, Any]) -> str:
    """Return errors, hand-eye translation, advice and warnings, a line each."""
    return "\n".join(
        [
            *_headline(report),
            *_table(report),
            *_hand_eye(report),
            *_advice(report),
            *_warnings(report),
            f"Verdict: {report['verdict']}. {report['reason']}",
        ]
    )


def _headline(report: Mapping[str, Any]) -> list[str]:
    return [report["headline"]] if report["headline"] else []


def _warnings(report: Mapping[str, Any]) -> list[str]:
    """Return the first warnings, a line each, and how many more report.json holds.

    One that is the reason of the verdict is said there.
    """
    found = [warning for warning in report["warnings"] if warning != report["reason"]]
    shown = [f"Warning: {warning}" for warning in found[:_MOST_WARNINGS]]
    more = len(found) - len(shown)
    return [*shown, f"{more} more warnings are in report.json."] if more else shown


def _table(report: Mapping[str, Any]) -> list[str]:
    """Return the errors as aligned columns, millimetres."""
    lines = [f"{report['model']:<16}{'train':>18}{'held out':>20}"]
    lines += [f"{'mm':<16}{'mean abs':>9}{'RMS':>9}{'mean abs':>11}{'RMS':>9}"]
    for stage, halves in report["error_mm"].items():
        cells = [halves[half][kind] for half in ("train", "test") for kind in ("mean_abs", "rms")]
        text = ["-" if cell is None else f"{cell:.2f}" for cell in cells]
        name = stage.replace("hand_eye", "hand-eye").replace("_", " ")
        lines.append(f"{name:<16}{text[0]:>9}{text[1]:>9}{text[2]:>11}{text[3]:>9}")
    return lines


def _hand_eye(report: Mapping[str, Any]) -> list[str]:
    hand_eye = report["hand_eye"]
    if not hand_eye["estimated"]:
        return []
    lines = [
        hand_eye_text(hand_eye),
        noise_shift_text(hand_eye),
        assumptions_text(report["assumptions"]),
    ]
    return [*filter(None, lines)]


def _advice(report: Mapping[str, Any]) -> list[str]:
    """Return which poses to add, a line each; nothing if there is no advice."""
    advice = report["advice"]
    if advice is None:
        return []
    return [
        f"The largest standard error is {advice['worst_sigma_mm_or_mrad']:.2f} mm (or mrad), of "
        f"{report['observability']['weakest'][0]['direction']}. To lower it, add:",
        *(
            f"  {pose['target']:<14}{pose['distance_m']:6.2f} m, tilted {pose['tilt_deg']:.0f} "
            f"deg, rolled by {pose['roll_by_deg']:+.0f}: then {pose['worst_sigma_mm_or_mrad']:.2f}"
            for pose in advice["poses"]
        ),
    ]
