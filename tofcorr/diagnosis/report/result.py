"""What a diagnosis found, for programs: the content of `diagnosis.json`."""

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

from tofcorr.diagnosis.findings.how_far import Gap, Interval
from tofcorr.diagnosis.findings.select import Selection, closed_square
from tofcorr.diagnosis.findings.where import Region, Where, find_where
from tofcorr.diagnosis.findings.which import absorbed_share
from tofcorr.diagnosis.rerun.closure import Closure
from tofcorr.diagnosis.rerun.transfer import Transfer
from tofcorr.diagnosis.sums.study import Study

_MOST_REGIONS = 60


@dataclass(frozen=True, kw_only=True)
class Diagnosis:
    """All findings about one recording.

    Attributes:
        study: What was reckoned with.
        selection: Effects named.
        gap: Before and after.
        where: Before any effect is added.
        detected: Whether simulator and recording part: an effect is named, or the cause is unknown.
        p_value: The smallest of all effects that would close what counts; 1 if none would.
        unknown: A gap remains that no effect of the catalogue explains.
        detectable: Smallest size of each effect that would have been found, metres, or None.
        advice: What to record next.
        verdict: One paragraph for people.
        closure: The recording against the simulator with the effects in it; None: not simulated.
        transfer: Corrections trained on simulated and on real images, on real images; None: not
            trained.
        warnings: What was not as expected of the recording.
        extra: Further keys of the JSON.
    """

    study: Study
    selection: Selection
    gap: Gap
    where: Where
    detected: bool
    p_value: float
    unknown: bool
    detectable: dict[str, float | None]
    advice: list[str]
    verdict: str
    closure: Closure | None
    transfer: Transfer | None
    warnings: list[str]
    extra: dict[str, Any] = field(default_factory=dict)

    @property
    def gap_steps(self) -> list[tuple[str, float]]:
        """The gap after each named effect in turn, metres."""
        study, selection = self.study, self.selection
        before = self.gap.before**2
        after = self.gap.after**2
        names = selection.named
        steps = []
        base = float(study.left_out_squares(()).sum())
        count = float(study.blocks.count.sum())
        for position, name in enumerate(names[:-1]):
            present = [n for n in names[: position + 1] if n in selection.study.effects]
            sums = float(selection.study.left_out_squares(present).sum())
            steps.append((name, max(before - (base - sums) / count, 0.0) ** 0.5))
        if names:
            steps.append((names[-1], after**0.5))
        return steps

    @cached_property
    def where_after(self) -> Where:
        """With the effects named."""
        return find_where(self.selection.study, self.selection.columns)

    def to_mapping(self) -> dict[str, Any]:
        """Return plain values for JSON, lengths in millimetres."""
        gap = self.gap
        return {
            "format": "tofcorr-diagnosis",
            "version": 1,
            "gap_mm": {
                "before": _mm(gap.before),
                "before_ci": _interval_mm(gap.before_interval),
                "after": _mm(gap.after),
                "after_ci": _interval_mm(gap.after_interval),
                "floor": _mm(gap.floor),
                "closed_fraction": round(gap.closed, 4),
                "closed_ci": [round(end, 4) for end in gap.closed_interval],
                "floor_is_upper_bound": not gap.floor_from_repeats,
                "between_images": _mm(gap.between_images),
                "fixed_pattern": _mm(gap.fixed_pattern),
                "within_images": _mm(gap.within_images),
            },
            "parameter_gap_mm": {"as_given": _mm(gap.as_given), "refitted": _mm(gap.before)},
            "detected": self.detected,
            "p_value": round(self.p_value, 5),
            "effects": list(self.selection.named),
            "cause_sets": [list(members) for members in self.selection.sets],
            "unknown": self.unknown,
            "ranking": self._ranking(),
            "where": [_region(region) for region in self.where.regions[:_MOST_REGIONS]],
            "transfer_mm": self.transfer and _transfer(self.transfer.with_network),
            "transfer_parametric_mm": self.transfer and _transfer(self.transfer.parametric),
            "closure_mm": self.closure and _closure(self.closure),
            "hand_eye_shift_mm": _mm(gap.hand_eye_shift[0]),
            "hand_eye_shift_deg": round(gap.hand_eye_shift[1] * 57.29577951308232, 5),
            "minimum_detectable_mm": {
                name: None if size is None else _mm(size) for name, size in self.detectable.items()
            },
            "next_recording": self.advice,
            "verdict": self.verdict,
            "warnings": self.warnings,
            **self.extra,
        }

    def _ranking(self) -> list[dict[str, Any]]:
        """Return every effect as the first addition to the base model, the best first."""
        study, first = self.study, self.selection.first
        total = float(first.squares.sum() / study.blocks.count.sum())
        before = max(total - study.fit.floor**2, 0.0)
        entries = []
        for test in first.ordered():
            closed = closed_square(study, test)
            after = max(before - closed, 0.0) ** 0.5
            members = _aliases(self.selection, test.name)
            entries.append(
                {
                    "effect": test.name,
                    "closes_mm": _mm(before**0.5 - after),
                    "closed_fraction": round(min(max(closed / before, 0.0), 1.0), 4)
                    if before > 0
                    else 0.0,
                    "p_value": round(first.family_p_value(test.name), 5),
                    "aliases": members,
                    "available": True,
                    "missing": [],
                    "gain": round(test.gain, 2),
                    "score": round(test.score, 3),
                    "absorbed": round(absorbed_share(study, test.name), 3)
                    if test.name in study.effects
                    else None,
                }
            )
        for name, wants in study.missing.items():
            entries.append(
                {
                    "effect": name,
                    "closes_mm": None,
                    "closed_fraction": None,
                    "p_value": None,
                    "aliases": [],
                    "available": False,
                    "missing": wants,
                }
            )
        return entries


def _closure(closure: Closure) -> dict[str, Any]:
    return {
        "without_effects": _mm(closure.without_effects),
        "with_effects": _mm(closure.with_effects),
        "p_value": closure.p_value,
        "frames": closure.frames,
    }


def _transfer(errors: tuple[float, float, float]) -> dict[str, float]:
    names = ("trained_on_sim", "trained_on_sim_with_effects", "trained_on_real")
    return {name: _mm(error) for name, error in zip(names, errors, strict=True)}


def _aliases(selection: Selection, name: str) -> list[str]:
    for members in selection.sets:
        if name in members:
            return [other for other in members if other != name]
    return []


def _region(region: Region) -> dict[str, Any]:
    return {
        "covariate": region.covariate,
        "from": region.low,
        "to": region.high,
        "bias_mm": _mm(region.bias),
        "bias_ci": _interval_mm(region.interval),
        "p_value": round(region.p_value, 5),
        "kind": "trend" if region.trend else "bin",
    }


def _mm(metres: float) -> float:
    return round(metres * 1e3, 4)


def _interval_mm(interval: Interval) -> list[float]:
    return [_mm(interval[0]), _mm(interval[1])]
