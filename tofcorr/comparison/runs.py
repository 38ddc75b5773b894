"""`tofcorr.compare`: runs of one camera side by side."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import chi2, norm

from tofcorr.correction.state import STATE_FILE, CalibrationState, load_calibration
from tofcorr.digits import aligned, at_most
from tofcorr.errors import CalibrationDataError
from tofcorr.estimation.robust import LEVEL
from tofcorr.files import write_text
from tofcorr.options import resolve_options
from tofcorr.training.calibration import TrainingOptions
from tofcorr.training.judgement import report_of_run, stage_words


@dataclass(frozen=True)
class HandEyeDifference:
    """How the hand-eye transforms of two runs differ.

    Attributes:
        first: Name of the first run.
        second: Name of the second run.
        shift_mm: Length of the difference of the translations, millimetres.
        turn_deg: Angle between the rotations, degrees.
        p_value: How often chance makes as large a difference, by the standard errors of both.
    """

    first: str
    second: str
    shift_mm: float
    turn_deg: float
    p_value: float

    @property
    def significant(self) -> bool:
        """Whether chance makes as large a difference in less than one case of twenty."""
        return self.p_value < LEVEL

    def __str__(self) -> str:
        """Return the difference in one sentence."""
        differ = "differ significantly" if self.significant else "do not differ significantly"
        # A probability below the smallest number is not zero.
        chance = f"p = {self.p_value:.2g}" if self.p_value else f"p < {np.finfo(float).tiny:.0g}"
        size = f"{self.shift_mm:.2f} mm and {self.turn_deg:.3f} deg"
        return f"The hand-eyes of {self.first} and {self.second} {differ}: {size}, {chance}."


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class RunComparison:
    """Runs side by side; its `repr` is the short table that the command prints.

    Attributes:
        names: What each run is called: its folder.
        reports: The report.json of each.
        options: The options of each, by dotted key.
        hand_eyes: How the hand-eye transforms differ, a pair of runs each.
        notes: What limits the comparison, a sentence each.
    """

    names: tuple[str, ...]
    reports: tuple[Mapping[str, Any], ...]
    options: tuple[Mapping[str, Any], ...]
    hand_eyes: tuple[HandEyeDifference, ...]
    notes: tuple[str, ...]

    @property
    def verdict(self) -> str:
        """Which run predicts best, and whether hand-eye transforms differ."""
        errors = [one["error_mm"]["after"]["test"]["rms"] for one in self.reports]
        known = [(error, name) for error, name in zip(errors, self.names, strict=True) if error]
        best = "No run held frames out."
        if known:
            best = f"{min(known)[1]} has the smallest held-out error, {min(known)[0]:.2f} mm RMS."
        apart = [str(one) for one in self.hand_eyes if one.significant]
        same = ["No two hand-eyes differ significantly."] if self.hand_eyes else []
        return " ".join([best, *(apart[:2] or same)])

    @property
    def results(self) -> list[list[str]]:
        """Rows of cells: what the runs are, and what they found; a run a column."""
        rows = [["run", *self.names]]
        rows.append(["recording", *map(_recorded, self.reports)])
        rows += [[key, *(one[key] for one in self.reports)] for key in ("model", "verdict")]
        for stage, half in (("hand_eye_only", "test"), ("after", "train"), ("after", "test")):
            found = (one["error_mm"][stage][half]["rms"] for one in self.reports)
            where = f"{half.replace('test', 'held out')}, {stage_words(stage)}, mm RMS"
            rows.append([where, *("-" if one is None else f"{one:.2f}" for one in found)])
        for axis, name in enumerate("xyz"):
            rows.append([f"hand-eye {name}, mm", *(_along(one, axis) for one in self.reports)])
        turns = (np.linalg.norm(one["hand_eye"]["rotation_se_deg"]) for one in self.reports)
        rows.append(["hand-eye rotation, deg", *(f"± {turn:.3f}" for turn in turns)])
        return rows

    @property
    def differing(self) -> list[list[str]]:
        """Rows of cells: the options that differ, as `--set` calls them; a run a column."""
        keys = dict.fromkeys(key for one in self.options for key in one)
        rows = [[key, *(str(one.get(key, "-")) for one in self.options)] for key in keys]
        return [row for row in rows if len({*row[1:]}) > 1]

    def __repr__(self) -> str:
        """Return verdict, results and notes: 11 lines at most."""
        wanted = "run", "recording", "model", "verdict", "held out, after", "hand-eye"
        table = aligned(row for row in self.results if row[0].startswith(wanted))
        # The rotation's standard errors stand in the long text.
        return "\n".join([self.verdict, *table[:8], *at_most(2, self.notes)])

    @property
    def details(self) -> str:
        """Verdict, all results, the options that differ, every pair of hand-eyes, and notes."""
        table = aligned([*self.results, *self.differing])
        return "\n".join([self.verdict, *table, *map(str, self.hand_eyes), *self.notes])


def compare(runs: Sequence[str | Path], *, out: str | Path | None = None) -> RunComparison:
    """Put runs of one camera side by side: errors, hand-eye transforms, options that differ.

    Two hand-eye transforms are compared along six axes of the tool by their 95 % intervals, as if
    the runs were independent. Runs of the same frames are not: their difference is known better.

    Args:
        runs: Folders that `tofcorr train` made, at least two.
        out: HTML page to write; None writes nothing.

    Raises:
        CalibrationDataError: There are fewer than two runs, a folder holds none, runs are of
            different cameras or frames of the tool, or `out` does not end in .html, exists or
            cannot be written.
    """
    if len(runs) < 2:
        raise CalibrationDataError(f"{runs[0] if runs else 'compare'}: give two runs at least.")
    if out is not None:
        from tofcorr.pages.page import refuse_page

        refuse_page(Path(out))
    states = [load_calibration(Path(run) / STATE_FILE) for run in runs]
    for state, run in zip(states[1:], runs[1:], strict=True):
        _refuse_other(state, states[0], f"{run}: cannot be compared with {runs[0]}")
    short = [Path(run).resolve().name for run in runs]
    names = tuple(short if len({*short}) == len(short) else map(str, runs))
    reports = tuple(report_of_run(Path(run)) for run in runs)
    files = [str(Path(run) / "config.yaml") for run in runs]
    options = [resolve_options(TrainingOptions, file).to_mapping() for file in files]
    found = RunComparison(
        names=names,
        reports=reports,
        options=tuple(_flat(one) for one in options),
        hand_eyes=tuple(
            _difference(a, b)
            for a, b in combinations(zip(names, reports, strict=True), 2)
            if a[1]["hand_eye"]["estimated"] and b[1]["hand_eye"]["estimated"]
        ),
        notes=tuple(_notes(reports)),
    )
    if out is not None:
        from tofcorr.pages.page import page_text

        text = page_text("tofcorr.comparison", "runs.html.j2", {}, {}, found=found)
        write_text(out, text, CalibrationDataError)
    return found


def _refuse_other(state: CalibrationState, first: CalibrationState, start: str) -> None:
    """Refuse a run of another camera, or whose hand-eye is between other frames."""
    if state.camera != first.camera or state.depth_kind != first.depth_kind:
        cameras = " and ".join(
            f"{one.camera.width}x{one.camera.height} pixels of {one.depth_kind} depth"
            for one in (state, first)
        )
        raise CalibrationDataError(f"{start}: the cameras or their lenses differ ({cameras}).")
    if state.frames != first.frames:
        frames = " and ".join(f"{one.frames.tool} to {one.frames.camera}" for one in (state, first))
        raise CalibrationDataError(f"{start}: the hand-eyes join other frames ({frames}).")


def _flat(options: Mapping[Any, Any], above: str = "") -> dict[str, Any]:
    """Return the values of nested options by dotted key."""
    found = dict[str, Any]()
    for key, value in options.items():
        own, inner = f"{above}{key}", value
        if isinstance(value, (list, tuple)):
            inner = dict(enumerate(value))
        found |= _flat(inner, f"{own}.") if isinstance(inner, Mapping) else {own: inner}
    return found


def _difference(
    first: tuple[str, Mapping[str, Any]], second: tuple[str, Mapping[str, Any]]
) -> HandEyeDifference:
    (one, a), (other, b) = ((name, report["hand_eye"]) for name, report in (first, second))
    here, there = (np.array(each["tool_from_camera"]) for each in (a, b))
    shift = 1e3 * (there[:3, 3] - here[:3, 3])
    # Along the tool's axes, as the standard errors.
    turn = np.degrees(Rotation.from_matrix(there[:3, :3] @ here[:3, :3].T).as_rotvec())
    ends = [[*each["translation_ci95_mm"], *each["rotation_ci95_deg"]] for each in (a, b)]
    error = np.hypot(*np.array(ends)) / norm.ppf(1 - LEVEL / 2)
    squares = float(np.sum((np.concatenate([shift, turn]) / error) ** 2))
    size = float(np.linalg.norm(shift)), float(np.linalg.norm(turn))
    return HandEyeDifference(one, other, *size, p_value=float(chi2.sf(squares, len(error))))


def _notes(reports: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return what limits a comparison, a sentence each."""
    recordings = {str(one.get("recordings")) for one in reports}
    if "None" in recordings:
        return ["A run was made by an older program, and does not say of which recording it is."]
    if len(recordings) > 1:
        return ["The runs are of different recordings: their errors are of different frames."]
    if len({str(one["frames"]) for one in reports}) > 1:
        return ["The runs held out different frames: small differences of errors mean nothing."]
    return []


def _recorded(report: Mapping[str, Any]) -> str:
    return ", ".join(Path(one).name for one in report.get("recordings", ["unknown"]))


def _along(report: Mapping[str, Any], axis: int) -> str:
    value = 1e3 * report["hand_eye"]["tool_from_camera"][axis][3]
    return f"{value:.2f} ± {report['hand_eye']['translation_se_mm'][axis]:.2f}"
