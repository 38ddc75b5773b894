"""The comparison of models in TensorBoard."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from tofcorr.training.monitor import event_writer


def write_comparison(folder: Path, image: np.ndarray, tables: Sequence[str]) -> None:
    """Write the comparison of models for TensorBoard.

    Args:
        folder: Where the event files go.
        image: The chart, shape (H, W, 3), uint8.
        tables: The tables, in Markdown.
    """
    with event_writer(folder) as writer:
        writer.add_image("comparison/held_out_error", image, dataformats="HWC")
        writer.add_text("comparison/tables", "\n\n".join(tables))
