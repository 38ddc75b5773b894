"""The gap in three stages: the simulator as given, recalibrated, and with the effects named."""

from dataclasses import dataclass
from typing import Literal

from torch import Tensor

from tofcorr.diagnosis.findings.covariates import binned_covariates
from tofcorr.diagnosis.findings.how_far import Gap
from tofcorr.diagnosis.findings.naming import NamedEffects
from tofcorr.diagnosis.findings.resamples import Interval
from tofcorr.diagnosis.findings.where import Where, find_where
from tofcorr.diagnosis.sums.study import Study

StageName = Literal["as_given", "recalibrated", "with_effects"]


@dataclass(frozen=True, kw_only=True)
class Stage:
    """The gap at one stage.

    Attributes:
        name: Which stage.
        gap, interval: Root mean square in excess of the noise, metres, with 95 % interval; None at
            the stage as given if no simulator was.
        where: The bias along all covariates and over the image; None likewise.
    """

    name: StageName
    gap: float | None
    interval: Interval | None
    where: Where | None

    @property
    def found_where(self) -> Where:
        """Where the bias lies, at a stage that exists."""
        if self.where is None:
            raise ValueError(f"There is no stage {self.name}: no simulator was given.")
        return self.where


def stages_of(
    study: Study, named: NamedEffects, gap: Gap, residual: Tensor | None
) -> tuple[Stage, Stage, Stage]:
    """Return the three stages.

    Args:
        study: The recording, before any effect was named.
        named: The effects named.
        gap: Before and after them.
        residual: Of the simulator as given, shape (M,), metres; None: none was given.
    """
    binned = binned_covariates(study)
    recalibrated = find_where(study, binned=binned)
    with_effects = recalibrated
    if named.names or named.refined_terms:
        with_effects = find_where(named.study, named.columns, binned=binned)
    return (
        Stage(
            name="as_given",
            gap=gap.as_given,
            interval=gap.as_given_interval,
            where=None if residual is None else find_where(study, residual=residual, binned=binned),
        ),
        Stage(
            name="recalibrated",
            gap=gap.before,
            interval=gap.before_interval,
            where=recalibrated,
        ),
        Stage(name="with_effects", gap=gap.after, interval=gap.after_interval, where=with_effects),
    )
