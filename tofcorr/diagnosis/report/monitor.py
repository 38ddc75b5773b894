"""The findings of a diagnosis in TensorBoard, as numbers; the page has the pictures."""

import math
from pathlib import Path

from tofcorr.diagnosis.findings.where import Stage
from tofcorr.diagnosis.report.result import DiagnosisResult
from tofcorr.training.monitor import event_writer


def write_events(result: DiagnosisResult, folder: Path | str) -> None:
    """Write verdict, gap, effects, and the residual along covariates and poses as event files.

    A curve has one step for each bin of its covariate, or for each pose.

    Args:
        result: What was found.
        folder: Usually REPORT/tb; made if it is missing.
    """
    with event_writer(folder) as writer:
        writer.add_text("verdict", result.verdict)
        gap = result.gap
        for stage in result.stages:
            if stage.gap is not None:
                writer.add_scalar(f"stage_mm/{stage.name}", 1e3 * stage.gap)
        writer.add_scalar("gap_mm/before", 1e3 * gap.before)
        writer.add_scalar("gap_mm/after", 1e3 * gap.after)
        writer.add_scalar("gap_mm/floor", 1e3 * gap.floor)
        for entry in result.ranking:
            writer.add_scalar(f"score/{entry.name}", entry.score)
        for share in result.shares:
            writer.add_scalar(f"share/{share.cause}", share.share)
        for stage in result.stages_known:
            for tag, values in _curves(stage).items():
                for step, value in enumerate(values):
                    if math.isfinite(value):
                        writer.add_scalar(tag, 1e3 * value, step)


def _curves(stage: Stage) -> dict[str, list[float]]:
    """Return the mean residual along covariates and poses by tag, metres."""
    where = stage.found_where
    curves = {f"pose_mm/{stage.name}": where.offsets.tolist()}
    for covariate, regions in where.by_covariate().items():
        tag = f"bias_mm_{stage.name}/{covariate}"
        curves[tag] = [region.bias for region in regions if not region.trend]
    return curves
