"""The findings and figures of a diagnosis in TensorBoard."""

from collections.abc import Mapping
from pathlib import Path

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from torch.utils.tensorboard import SummaryWriter

from tofcorr.diagnosis.report.result import DiagnosisResult


def write_events(
    result: DiagnosisResult, figures: Mapping[str, Figure], folder: Path | str
) -> None:
    """Write verdict, gap, effects and figures as event files.

    Args:
        result: What was found.
        figures: By name.
        folder: Usually REPORT/tb; made if it is missing.
    """
    with SummaryWriter(str(folder)) as writer:
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
        for name, figure in figures.items():
            writer.add_figure(name, _drawable(figure))


def _drawable(figure: Figure) -> Figure:
    """Attach the canvas that TensorBoard draws on."""
    FigureCanvasAgg(figure)
    return figure
