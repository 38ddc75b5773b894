"""The comparison of models in TensorBoard."""

from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

from matplotlib.figure import Figure
from torch.utils.tensorboard import SummaryWriter

from tofcorr.training.figures import pixels_of


def write_comparison(folder: Path, figure: Figure, tables: Sequence[str]) -> None:
    """Write the comparison of models for TensorBoard.

    Args:
        folder: Where the event files go.
        figure: The chart.
        tables: The tables, in Markdown.
    """
    with closing(SummaryWriter(str(folder))) as writer:
        writer.add_image("comparison/held_out_error", pixels_of(figure), dataformats="HWC")
        writer.add_text("comparison/tables", "\n\n".join(tables))
