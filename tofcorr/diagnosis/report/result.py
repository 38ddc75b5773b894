"""The result of a diagnosis, and what it writes: `diagnosis.json`, the page, `sensor.yaml`."""

import json
import math
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from tofcorr.diagnosis.findings.gap import Gap, OpenSet
from tofcorr.diagnosis.findings.naming import NamedEffects
from tofcorr.diagnosis.findings.outliers import Outliers
from tofcorr.diagnosis.findings.shares import Share, alike
from tofcorr.diagnosis.findings.where import Estimated, Stage
from tofcorr.diagnosis.given import SimulatorKind
from tofcorr.diagnosis.options import DiagnosisOptions
from tofcorr.diagnosis.report.words import (
    SMALL,
    STAGE_WORDS,
    along,
    biases_of,
    cause_words,
    effect_words,
    mm,
    p_words,
    percent,
    pose_errors,
    share_words,
    sized,
    stages_shown,
    table_of_stages,
)
from tofcorr.diagnosis.rerun.checks import Closure, DegradedStage, Transfer
from tofcorr.diagnosis.rerun.simulator import Evidence, FittedValue, sensor_of
from tofcorr.diagnosis.sums.study import Study, absorbed_share
from tofcorr.digits import at_most, in_mm, known, known_interval, with_interval
from tofcorr.observables.compare import Observables
from tofcorr.observables.pairs import LEAST_P
from tofcorr.options import dump_yaml
from tofcorr.progress import event_writer
from tofcorr.scene_light.bounces import SecondBouncesState
from tofcorr.sensor.sensor_file import FILE_NAME, sensor_text
from tofcorr.simulation.effects.multipath import SECOND_BOUNCES, second_bounces_state
from tofcorr.simulation.effects.registry import CATALOGUE
from tofcorr.simulation.options import SimulatorOptions

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, kw_only=True, repr=False, eq=False)
class DiagnosisResult:
    """All findings about one recording. Its `repr` is the verdict, with the warnings.

    Attributes:
        verdict: The finding in three sentences.
        causes: A line for each cause of the gap, the largest first.
        remarks: What else must be said, a sentence or two each.
        simulator_kind: `given` (options of the built-in simulator), `rendered` (frames of another
            one) or `fitted` (none was given).
        stages: The gap as given, recalibrated, and with the effects.
        shares: The share of each cause in the square of the gap as given; they sum to one.
        warnings: What was unexpected about the recording, a sentence each.
        detected: Whether simulator and recording differ: an effect is named, or the cause is
            unknown.
        probability: That anything is missing.
        effects: The effects named, in the order added.
        cause_sets: For each of them those that the data cannot distinguish from it, itself first.
        gap: Before and after the effects.
        gap_steps: The gap after each named effect in turn, metres.
        remainder: Whether a gap of unknown cause remains, and what it looks like.
        outliers: Pixels that gap and effects do not describe.
        detectable: The smallest size of each effect that would have been found, metres; None: the
            effect is not identifiable.
        advice: What to record next, a sentence or two each.
        closure: The check in the simulator; None: not simulated.
        transfer: Errors of corrections trained on simulated and on real images; None: not trained.
        fitted: Hand-eye transform and coefficients of the final model, as in `sensor.yaml`.
        degraded: What ideal frames through `sensor.yaml` leave; None: not degraded.
        observables: Noise, missing pixels and amplitude of recording and simulator.
        simulator: The built-in simulator with the named effects; None where another one rendered
            frames.
        options: Of the diagnosis.
        evidence: What the findings were computed from.
    """

    verdict: str
    causes: tuple[str, ...]
    remarks: tuple[str, ...]
    simulator_kind: SimulatorKind
    stages: tuple[Stage, Stage, Stage]
    shares: tuple[Share, ...]
    warnings: tuple[str, ...]
    detected: bool
    probability: float
    effects: tuple[str, ...]
    cause_sets: tuple[tuple[str, ...], ...]
    gap: Gap
    gap_steps: tuple[tuple[str, Estimated], ...]
    remainder: OpenSet
    outliers: Outliers
    detectable: dict[str, float | None]
    advice: tuple[str, ...]
    closure: Closure | None
    transfer: Transfer | None
    fitted: tuple[FittedValue, ...]
    degraded: DegradedStage | None
    observables: Observables
    simulator: SimulatorOptions | None
    options: DiagnosisOptions
    evidence: Evidence = field(repr=False)

    def __repr__(self) -> str:
        """Return verdict, stages, the largest causes and one warning: 11 lines at most."""
        lines = [self.verdict, *table_of_stages(self), *at_most(3, self._causes)]
        return "\n".join([*lines, *at_most(2, self._warnings)])

    @property
    def details(self) -> str:
        """Verdict, stages, and every cause, remark and warning."""
        lines = [self.verdict, *table_of_stages(self), *self._causes, *self.remarks]
        return "\n".join([*lines, *self._warnings])

    @property
    def _causes(self) -> list[str]:
        return [f"- {cause}" for cause in self.causes]

    @property
    def _warnings(self) -> list[str]:
        return [f"Warning: {warning}" for warning in self.warnings]

    @property
    def unknown(self) -> bool:
        """Whether a gap remains that no effect of the catalogue explains."""
        return self.remainder.unknown

    @property
    def second_bounces(self) -> SecondBouncesState | None:
        """Second bounces, where multipath was named as those by surfaces that the frames show."""
        intervals = [one.interval for one in self.fitted if one.name == SECOND_BOUNCES]
        frequency = self.evidence.study.inputs.modulation_frequency
        found = (second_bounces_state(own, frequency, *intervals) for own in self.evidence.effects)
        return next(filter(None, found), None)

    def to_mapping(self) -> dict[str, Any]:
        """Return the content of `diagnosis.json`: plain values, lengths in millimetres."""
        gap, remainder, named = self.gap, self.remainder, self.evidence.named
        outliers, transfer, closure = self.outliers, self.transfer, self.closure
        degraded = self.degraded
        untested = {"closes_mm": None, "closed_fraction": None, "probability": None, "aliases": []}
        lengths = "before", "after", "floor", "between_images", "fixed_pattern", "within_images"
        lists = "effects", "causes", "remarks", "warnings"
        trainings = "trained_on_sim", "trained_on_sim_with_effects", "trained_on_real"
        return {
            "format": "tofcorr-diagnosis",
            "version": 3,
            "simulator": self.simulator_kind,
            "stages": [
                # As many places as fit beside a picture.
                {"name": stage.name, **_sized(stage.gap), "where": _regions(stage, 5)}
                for stage in self.stages
            ],
            "attribution": [
                {"cause": one.cause, "kind": one.kind, "share": round(one.share, 4)}
                | {"ci": _rounded(one.share.interval)}
                | ({} if one.of_constant is None else {"of_constant": round(one.of_constant, 4)})
                | {"aliases": alike(self.evidence.study, one.cause)}
                for one in self.shares
            ],
            "gap_mm": {
                **{name: _mm(getattr(gap, name)) for name in lengths},
                **{f"{name}_ci": _mm(getattr(gap, name).interval) for name in ("before", "after")},
                "closed_fraction": round(gap.closed, 4),
                "closed_ci": _rounded(gap.closed.interval),
                "floor_is_upper_bound": not gap.floor_from_repeats,
            },
            "parameter_gap_mm": {"as_given": _mm(gap.as_given), "refitted": _mm(gap.before)},
            "detected": self.detected,
            "probability": round(self.probability, 4),
            "cause_sets": [list(members) for members in self.cause_sets],
            "set_probabilities": [round(named.probability_of_any(*s), 4) for s in self.cause_sets],
            # Of each member to be the one there, given the other effects.
            "cause_sets_shares": [
                {name: round(share, 4) for name, share in own.items()}
                for own in named.sets.values()
            ],
            "unknown": remainder.unknown,
            "unknown_probability": round(named.unknown, 4),
            "outliers": {
                "deleted_share": round(outliers.deleted, 6),
                "reduced_share": round(outliers.reduced, 6),
                "rms_mm": _mm(outliers.size),
                "where": outliers.place,
            },
            "ranking": [_ranked(self.evidence.study, named, name) for name in named.ranking]
            + [
                {"effect": name, **untested, "available": False, "missing": missing}
                for name, missing in self.evidence.study.missing.items()
            ],
            "where": _regions(self.stages[1], 60),  # More than anyone reads.
            "transfer_mm": transfer
            and {
                **{name: _mm(getattr(transfer, name)) for name in trainings},
                "ci": {name: _mm(getattr(transfer, name).interval) for name in trainings},
                "gain_ci": _mm(transfer.gain.interval),
            },
            "fitted": [
                {name: getattr(one, name) for name in ("cause", "kind", "name", "unit")}
                | {
                    "value": _finite(one.value),
                    "ci": one.interval and [*map(_finite, one.interval)],
                }
                for one in self.fitted
            ],
            "closure_mm": closure
            and {name: _mm(getattr(closure, name)) for name in ("without_effects", "with_effects")}
            | {"frames": closure.frames},
            "degraded": degraded
            and {
                **_sized(degraded.gap),
                "poses": degraded.poses,
                "left_out": list(degraded.left_out),
            },
            "second_bounces": self.second_bounces and self.second_bounces.to_mapping(),
            **self.observables.to_dict(),
            "hand_eye_shift_mm": _mm(gap.hand_eye_shift[0]),
            "hand_eye_shift_deg": round(math.degrees(gap.hand_eye_shift[1]), 5),
            "minimum_detectable_mm": {name: _mm(size) for name, size in self.detectable.items()},
            "next_recording": list(self.advice),
            "verdict": self.verdict,
            **{name: list(getattr(self, name)) for name in lists},
            "fingerprint": list(remainder.fingerprint),
        }

    def plot(self, name: str) -> "Figure":
        """Return one figure, by its name in `tofcorr.diagnosis.report.figures.FIGURES`."""
        # With it comes matplotlib, which takes half as long to import as torch.
        from tofcorr.diagnosis.report.figures import FIGURES

        return FIGURES[name](self)


def _ranked(study: Study, named: NamedEffects, name: str) -> dict[str, Any]:
    """Return the entry of a tested effect in `ranking`."""
    closes, fraction = named.closed_gap(name)
    members = next((own for own in named.cause_sets if name in own), ())
    absorbed = None
    if name in study.effects:
        absorbed = round(absorbed_share(study, name), 3)
    return {
        "effect": name,
        "closes_mm": _mm(closes),
        "closed_fraction": round(fraction, 4),
        "probability": round(named.probabilities.get(name, 0.0), 4),
        "aliases": [other for other in members if other != name],
        "available": True,
        "missing": [],
        "absorbed": absorbed,
    }


def _regions(stage: Stage, most: int) -> list[dict[str, Any]]:
    """Return entries of `where`, the most significant first."""
    return [
        {
            "covariate": region.covariate,
            "from": region.low,
            "to": region.high,
            "bias_mm": _mm(region.bias),
            "bias_ci": _mm(region.bias.interval),
            "p_value": round(region.p_value, 5),
            "kind": "trend" if region.trend else "bin",
        }
        for region in stage.regions[:most]
    ]


def _mm(metres: float | tuple[float, float] | None) -> Any:  # noqa: ANN401 - as what is given
    """Return a length or an interval in millimetres, rounded to 0.1 um; None stays None."""
    if isinstance(metres, tuple):
        return [_mm(end) for end in metres]
    return None if metres is None else round(metres * 1e3, 4)


def _sized(gap: Estimated | None) -> dict[str, Any]:
    """Return a gap and its interval, millimetres."""
    return {"gap_mm": _mm(gap), "ci": None if gap is None else _mm(gap.interval)}


def _rounded(interval: tuple[float, float]) -> list[float]:
    """Return the ends of an interval of a share to four digits."""
    return [round(end, 4) for end in interval]


def _finite(number: float) -> float | None:
    return float(f"{number:.6g}") if math.isfinite(number) else None


def write_report(result: DiagnosisResult, folder: Path) -> None:
    """Write `diagnosis.json`, `sensor.yaml`, and `report.html` and `tb/` if wanted.

    Where the built-in simulator was used, `simulator_with_effects.yaml` is written too.

    Args:
        result: What was found.
        folder: Where to write; it exists.

    Raises:
        OSError: It cannot be written.
    """
    findings = json.dumps(result.to_mapping(), indent=1, ensure_ascii=False, allow_nan=False)
    sensor = sensor_of(result.evidence, result.observables)
    sensor = sensor.model_copy(update={"second_bounces": result.second_bounces})
    texts = {"diagnosis.json": findings + "\n", FILE_NAME: sensor_text(sensor)}
    if result.simulator is not None:
        texts["simulator_with_effects.yaml"] = dump_yaml(result.simulator.to_mapping())
    if result.options.page:
        texts["report.html"] = render(result)
        write_events(result, folder / "tb")
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="utf-8")


def render(result: DiagnosisResult) -> str:
    """Return the page: one HTML file that needs nothing else."""
    from tofcorr.diagnosis.report.figures import all_figures
    from tofcorr.pages.page import page_text

    study, named = result.evidence.study, result.evidence.named
    filters = {
        "mm": in_mm,
        "metres": mm,
        "known": known,
        "known_interval": known_interval,
        "sized": sized,
        "percent": lambda share: "–" if share is None else percent(share),
        "share": share_words,
        "small": lambda share: abs(share) < SMALL,
        "negative": lambda share: share < 0 and percent(share) != "0 %",
        "probability": lambda p: "–" if p is None else f"{p:.2f}",
        "effect": partial(effect_words, study),
        "cause": partial(cause_words, study),
        "along": along,
        "p_of_draws": lambda p: p_words(p, LEAST_P),
        "with_digits": lambda one: with_interval(one["value"], one["ci"]),
    }
    return page_text(
        "tofcorr.diagnosis.report",
        "report.html.j2",
        all_figures(result),
        filters,
        **result.to_mapping(),
        result=result,
        study=study,
        shown=stages_shown(result),
        pose_errors=pose_errors(result),
        closed={name: named.closed_gap(name)[1] for name in named.ranking},
        catalogue=CATALOGUE,
        stage_words=STAGE_WORDS,
        libraries=f"torch {torch.__version__}, NumPy {np.__version__}",
    )


def write_events(result: DiagnosisResult, folder: Path | str) -> None:
    """Write verdict, gap, effects, and the residual along covariates and poses for TensorBoard.

    A curve has one step for each bin of its covariate, or for each pose; the page has pictures.

    Args:
        result: What was found.
        folder: Usually REPORT/tb; made if it is missing.
    """
    gap, probabilities = result.gap, result.evidence.named.probabilities
    numbers = {f"stage_mm/{s.name}": 1e3 * s.gap for s in result.stages if s.gap is not None}
    numbers |= {f"gap_mm/{part}": 1e3 * getattr(gap, part) for part in ("before", "after", "floor")}
    numbers |= {f"probability/{name}": own for name, own in probabilities.items()}
    numbers |= {f"share/{cause.cause}": cause.share for cause in result.shares}
    curves: dict[str, list[float]] = {}
    for stage in stages_shown(result):
        curves[f"pose_mm/{stage.name}"] = stage.offsets.tolist()
        for covariate, regions in stage.by_covariate().items():
            curves[f"bias_mm_{stage.name}/{covariate}"] = list(map(float, biases_of(regions)))
    with event_writer(folder) as writer:
        writer.add_text("verdict", result.verdict)
        for tag, number in numbers.items():
            writer.add_scalar(tag, number)
        for tag, values in curves.items():
            for step, value in enumerate(values):
                if math.isfinite(value):
                    writer.add_scalar(tag, 1e3 * value, step)
