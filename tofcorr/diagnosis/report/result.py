"""The result of a diagnosis."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from torch import Tensor

from tofcorr.diagnosis.findings.effect_comparison import EffectTest
from tofcorr.diagnosis.findings.gap import Gap, OpenSet
from tofcorr.diagnosis.findings.naming import NamedEffects
from tofcorr.diagnosis.findings.outliers import Outliers
from tofcorr.diagnosis.findings.shares import Share
from tofcorr.diagnosis.findings.where import Estimated, Stage
from tofcorr.diagnosis.given.simulator import SimulatorKind
from tofcorr.diagnosis.options import DiagnosisOptions
from tofcorr.diagnosis.report.mapping import content_of
from tofcorr.diagnosis.rerun.checks import Closure, Transfer
from tofcorr.diagnosis.rerun.sensor import DegradedStage, FittedValue
from tofcorr.diagnosis.sums.study import Study
from tofcorr.observables.compare import Observables
from tofcorr.simulation.options import SimulatorOptions

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, kw_only=True)
class Evidence:
    """What the findings were computed from.

    Attributes:
        study: The recording, before any effect was named.
        named: The effects named, with all comparisons.
        patterns: Values of maps in all pixels, shape (cells,), metres, by name, where the study has
            only some of them.
    """

    study: Study
    named: NamedEffects
    patterns: Mapping[str, Tensor] = field(default_factory=dict)


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
        p_value: The smallest of all effects that close enough to count; 1 if none does.
        effects: The effects named, in the order added.
        cause_sets: For each of them those that the data cannot distinguish from it, itself first.
        likeliest: Effects that may explain what remains but are not significant, at most three, the
            likeliest first.
        refined_terms: Base terms that a higher-order form was added to, too small to report.
        tested: Whether there were enough poses for a test; if not, effects are only ranked.
        gap: Before and after the effects.
        gap_steps: The gap after each named effect in turn, metres.
        remainder: Whether a gap of unknown cause remains, and what it looks like.
        outliers: Pixels that gap and effects do not describe.
        ranking: Every tested effect as the first addition to the base model, the best first.
        missing: Untestable effects and their missing inputs.
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
    p_value: float
    effects: tuple[str, ...]
    cause_sets: tuple[tuple[str, ...], ...]
    likeliest: tuple[str, ...]
    refined_terms: tuple[str, ...]
    tested: bool
    gap: Gap
    gap_steps: tuple[tuple[str, Estimated], ...]
    remainder: OpenSet
    outliers: Outliers
    ranking: tuple[EffectTest, ...]
    missing: dict[str, list[str]]
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
        """Return the verdict, the causes, the remarks and the warnings, a line each."""
        lines = [self.verdict, *(f"- {cause}" for cause in self.causes), *self.remarks]
        return "\n".join([*lines, *(f"Warning: {warning}" for warning in self.warnings)])

    @property
    def unknown(self) -> bool:
        """Whether a gap remains that no effect of the catalogue explains."""
        return self.remainder.unknown

    def to_mapping(self) -> dict[str, Any]:
        """Return the content of `diagnosis.json`: plain values, lengths in millimetres."""
        return content_of(self)

    @property
    def where(self) -> Stage:
        """Bias along all covariates, after recalibration."""
        return self.stages[1]

    def all_figures(self) -> "dict[str, Figure]":
        """Return every figure, by its name on the report page."""
        from tofcorr.diagnosis.report.figures import all_figures

        return all_figures(self)

    def _draw(self, name: str) -> "Figure":
        # With it comes matplotlib, which takes half as long to import as torch.
        from tofcorr.diagnosis.report.figures import FIGURES

        return FIGURES[name](self)

    def plot_gap(self) -> "Figure":
        """Draw the gap at each stage, with intervals."""
        return self._draw("stages")

    def plot_attribution(self) -> "Figure":
        """Draw the share of each cause in the squared gap, with intervals."""
        return self._draw("attribution")

    def plot_where_as_given(self) -> "Figure":
        """Draw the bias of the simulator as given; of the fitted one without a simulator."""
        return self._draw("where_as_given")

    def plot_where(self) -> "Figure":
        """Draw the bias after recalibration, and with the effects, along covariates."""
        return self._draw("where")

    def plot_image(self) -> "Figure":
        """Draw the mean residual over the image at each stage."""
        return self._draw("map")

    def plot_pose_series(self) -> "Figure":
        """Draw the mean residual of each pose in the order of the recording."""
        return self._draw("series")

    def plot_effects(self) -> "Figure":
        """Draw what each effect closes, with intervals, and its score."""
        return self._draw("which")

    def plot_absorption(self) -> "Figure":
        """Draw the share of each effect that calibration and other effects absorb."""
        return self._draw("aliases")

    def plot_poses(self) -> "Figure":
        """Draw the held-out error of each pose before and after the effects."""
        return self._draw("poses")
