"""The comparison of models in TensorBoard."""

from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

import numpy as np
from torch.utils.tensorboard import SummaryWriter


def write_comparison(folder: Path, image: np.ndarray, tables: Sequence[str]) -> None:
    """Write the comparison of models for TensorBoard.

    Args:
        folder: Where the event files go.
        image: The chart, shape (H, W, 3), uint8.
        tables: The tables, in Markdown.
    """
    with closing(SummaryWriter(str(folder))) as writer:
        writer.add_image("comparison/held_out_error", image, dataformats="HWC")
        writer.add_text("comparison/tables", "\n\n".join(tables))
