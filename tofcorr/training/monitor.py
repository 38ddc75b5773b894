"""Watches a calibration in TensorBoard."""

from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np
from torch.utils.tensorboard import SummaryWriter

from tofcorr.estimation.solution import Iteration
from tofcorr.training.dataset import Dataset
from tofcorr.training.fitting import Fit


class RunMonitor:
    """Writes what happens in a run for TensorBoard.

    `iteration` is a `Watcher`: pass it to `fit`. `finish` is called once, after the fit.

    Args:
        folder: Where the event files go, usually RUN/tb; made if it is missing.

    Example:
        with RunMonitor(run / "tb") as monitor:
            fitted = fit(dataset, train, options, domain, watcher=monitor.iteration)
            monitor.finish(dataset, fitted, train, test)
    """

    def __init__(self, folder: Path | str) -> None:
        self._writer = SummaryWriter(str(folder))
        self._iterations: list[Iteration] = []

    def iteration(self, iteration: Iteration) -> None:
        """Record one iteration of the solver; never interrupts it."""
        self._iterations.append(iteration)

    def finish(
        self,
        dataset: Dataset,
        fit: Fit,
        train: np.ndarray,
        test: np.ndarray,
        summary: Mapping[str, object] | None = None,
    ) -> None:
        """Record what can only be shown after the fit.

        Args:
            dataset: The recordings.
            fit: The fitted model.
            train: Global numbers of the frames fitted.
            test: Global numbers of the frames held out; may be empty.
            summary: What to show as text, by heading; report.json's content, for one.
        """

    def close(self) -> None:
        """Write what is still buffered, and close the files."""
        self._writer.close()

    def __enter__(self) -> Self:
        """Return the monitor."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Close the files, whatever happened."""
        self.close()
