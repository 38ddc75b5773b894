"""What each command makes of a recording, and whether that is a confident wrong number.

The recording of every fault comes from the simulator, and so does the clean one that it was made
from: what the command says of that one is what it should say. Wrong is, without a headline and
without a refusal:

- `train`: a hand-eye transform off by more than 5 mm or 0.5 degrees, and by more than four of the
  standard errors of the report, and a verdict other than `do not use`; where the report says that
  robot and camera differ in scale, its translation may be off by a tenth of itself;
- `evaluate`, `select`: a held-out error of the best model that is not a number, below half that of
  the clean recording, or above three times it and 5 mm;
- `check`, of the clean recording's calibration: an offset that differs from the true 0, by more
  than 1 mm beyond the interval;
- `diagnose`: a gap that is not a number, above 200 mm, or 5 mm above that of the clean recording
  with a cause that is of the light and not of the geometry.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

import tofcorr
from tofcorr.diagnosis.findings.outliers import LARGEST_GAP
from tofcorr.drift.offset import Wall
from tofcorr.errors import TofcorrError
from tofcorr.options import resolve_options
from tofcorr.training.calibration import TrainingOptions

# An error of the hand-eye counts as wrong above these, millimetres and degrees, and above so many
# of its own standard errors.
WRONG_MM, WRONG_DEG, SIGMAS = 5.0, 0.5, 4.0
# Error of all lengths of a hand-eye that is no wrong number if the report names their scale.
NAMED_SCALE = 0.1
# Effects of geometry: poses, planes, time and lens. A wrong recording may well be explained by one.
GEOMETRY = {
    *("target_registration", "robot_kinematics", "timestamp_offset", "motion"),
    *("lens", "target_shape", "mixed_pixels"),
}
WRONG = ("confident and wrong", "traceback")
KINDS = ("stopped", "do not use", "headline", "within its errors", *WRONG)
"""What may come of a command."""

Said = dict[str, Any]
"""`headline`, `sentence`, and the numbers that a command's answer is judged by."""


@dataclass(frozen=True)
class Clean:
    """A clean recording with its truth, its calibration, and what each command says of it.

    Attributes:
        folder: The recording.
        true_hand_eye: Shape (4, 4), metres.
        run: Folder for its calibration, made anew.
        said: What each command said of it.
    """

    folder: Path
    true_hand_eye: np.ndarray
    run: Path
    said: dict[str, Said] = field(default_factory=dict)

    def says(self, command: str) -> Said:
        """Return what a command says of it; run once."""
        if command not in self.said:
            self.said[command] = COMMANDS[command][0](self.folder, self)
        return self.said[command]

    def calibration(self) -> Path:
        """Return the folder of its run; trained once."""
        if not self.run.exists():
            tofcorr.train(self.folder, _training(), out=self.run, force=True)
        return self.run


def outcome(command: str, folder: Path, clean: Clean) -> Said:
    """Run a command on a recording and say what came, in the words of the summary's columns."""
    try:
        ask, is_wrong = COMMANDS[command]
        said = ask(folder, clean)
    except TofcorrError as error:
        return {"outcome": "stopped", "sentence": str(error).partition(": ")[2], "exit": 2}
    except Exception as error:  # noqa: BLE001 - a traceback is what is counted here
        return {"outcome": "traceback", "sentence": f"{type(error).__name__}: {error}", "exit": 1}
    if said.get("verdict") == "do not use":
        kind = "do not use"
    elif said["headline"]:
        kind = "headline"
    else:
        kind = "confident and wrong" if is_wrong(said, clean) else "within its errors"
    return said | {"outcome": kind, "exit": 0}


def _training() -> TrainingOptions:
    return resolve_options(TrainingOptions, "ea").model_copy(update={"advice": 0, "figures": False})


def _train(folder: Path, clean: Clean) -> Said:
    report = tofcorr.train(folder, _training()).report
    found, true = np.array(report["hand_eye"]["tool_from_camera"]), clean.true_hand_eye
    place = found[:3, 3]
    if any(one["check"] == "scale" for one in report["plausibility"]):
        least, most = 1 - NAMED_SCALE, 1 + NAMED_SCALE
        place = place * np.clip(place @ true[:3, 3] / (place @ place), least, most)
    cosine = (np.trace(found[:3, :3].T @ true[:3, :3]) - 1) / 2
    return {
        "headline": report["headline"],
        "sentence": report["headline"] or report["reason"],
        "verdict": report["verdict"],
        "off_mm": 1e3 * float(np.linalg.norm(place - true[:3, 3])),
        "off_deg": math.degrees(math.acos(float(np.clip(cosine, -1, 1)))),
        "se_mm": float(np.linalg.norm(report["hand_eye"]["translation_se_mm"])),
        "se_deg": float(np.linalg.norm(report["hand_eye"]["rotation_se_deg"])),
    }


def _train_is_wrong(said: Said, clean: Clean) -> bool:
    limits = {"mm": WRONG_MM, "deg": WRONG_DEG}
    return any(said[f"off_{k}"] > max(most, SIGMAS * said[f"se_{k}"]) for k, most in limits.items())


def _evaluate(folder: Path, clean: Clean) -> Said:
    result = tofcorr.evaluate(folder, {"models": _models("EA"), "folds": 0})
    (one,) = result.to_mapping()["sets"]
    (protocol,) = one["held_out"].values()
    error = protocol["error_mm"]["mean_abs_mm"]["EA"]["mean"]
    return _held_out(" ".join(result.headlines) or None, math.nan if error is None else error)


def _select(folder: Path, clean: Clean) -> Said:
    result = tofcorr.select(folder, {"models": _models("EA", "E0"), "folds": 3, "by": ["image"]})
    return _held_out(result.headline, result.decisive.errors[result.winner].mean)


def _held_out(headline: str | None, error: float) -> Said:
    sentence = headline or f"{error:.2f} mm held out"
    return {"headline": headline, "sentence": sentence, "error_mm": error}


def _models(*names: str) -> list[dict[str, Any]]:
    return [
        {"name": name, "model": resolve_options(TrainingOptions, name.lower()).model.to_mapping()}
        for name in names
    ]


def _error_is_wrong(command: str, said: Said, clean: Clean) -> bool:
    error, right = said["error_mm"], clean.says(command)["error_mm"]
    return not 0.5 * right <= error <= max(3 * right, right + WRONG_MM)


def _check(wall: Wall, folder: Path, clean: Clean) -> Said:
    found = tofcorr.check(clean.calibration(), folder, wall=wall)
    return {
        "headline": found.headline,
        "sentence": repr(found).splitlines()[1 if found.headline is None else 0],
        "interval_mm": [1e3 * end for end in found.interval],
    }


def _check_is_wrong(said: Said, clean: Clean) -> bool:
    low, high = said["interval_mm"]
    return not (low <= 1.0 and high >= -1.0)


def _diagnose(folder: Path, clean: Clean) -> Said:
    quick = {"page": False, "simulate_anew": False, "bootstraps": 19, "most_pixels": 10_000}
    found = tofcorr.diagnose(folder, config=quick)
    first = found.verdict.partition(". ")[0]
    doubtful = first.startswith(("Doubtful", "Ambiguous"))
    return {
        "headline": first if doubtful else None,
        "sentence": f"{found.verdict[:120]} {', '.join(found.effects)}",
        "gap_mm": 1e3 * found.gap.before,
        "effects": list(found.effects),
    }


def _diagnose_is_wrong(said: Said, clean: Clean) -> bool:
    gap, light = said["gap_mm"], set(said["effects"]) - GEOMETRY
    most = clean.says("diagnose")["gap_mm"] + WRONG_MM if light else math.inf
    return not gap <= min(1e3 * LARGEST_GAP, most)


COMMANDS: Mapping[str, tuple[Callable[[Path, Clean], Said], Callable[[Said, Clean], bool]]] = {
    "train": (_train, _train_is_wrong),
    "evaluate": (_evaluate, partial(_error_is_wrong, "evaluate")),
    "select": (_select, partial(_error_is_wrong, "select")),
    "check": (partial(_check, "per_image"), _check_is_wrong),
    "check recorded": (partial(_check, "recorded"), _check_is_wrong),
    "diagnose": (_diagnose, _diagnose_is_wrong),
}
"""What asks each command, and judges it; `check` with unknown and with recorded walls."""
