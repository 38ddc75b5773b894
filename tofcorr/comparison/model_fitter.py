"""Fits of named models to some of a data set's frames, from moments that are known already."""

from collections.abc import Callable, Mapping

import numpy as np

from tofcorr.comparison.evaluation_options import EvaluationOptions, NamedModel
from tofcorr.comparison.selection_options import SelectionOptions
from tofcorr.error_terms.domain import Domain
from tofcorr.estimation.moments import ImageMoments
from tofcorr.fit.fitting import Fit, fit
from tofcorr.pixels.dataset import Dataset
from tofcorr.training.options import TrainingOptions


class ModelFitter:
    """Fits models to some frames, just as a training would.

    Args:
        dataset: The recordings.
        domain: The ranges that scale the models' variables.
        moments: Of all frames, by the models' names.
        options: What is known of the hand-eye transform, solver and device.
        progress: Called after each fit.

    Attributes:
        warnings: A line for each fit that did not converge.
    """

    def __init__(
        self,
        dataset: Dataset,
        domain: Domain,
        moments: Mapping[str, ImageMoments],
        options: EvaluationOptions | SelectionOptions,
        progress: Callable[[], object] | None = None,
    ) -> None:
        self._dataset, self._domain, self._moments = dataset, domain, moments
        self._options, self._progress = options, progress
        self.warnings: list[str] = []

    def fit(self, model: NamedModel, frames: np.ndarray) -> Fit:
        """Fit one model to some frames (global numbers)."""
        training = TrainingOptions(
            name=model.name,
            model=model.model,
            residual=model.residual,
            hand_eye=self._options.hand_eye,
            solver=self._options.solver,
            device=self._options.device,
        )
        moments = self._moments[model.name].images(frames.tolist())
        found = fit(self._dataset, frames, training, self._domain, moments=moments)
        if not found.solution.converged:
            self.warnings.append(
                f"{model.name}, fitted to {len(frames)} frames: {found.solution.message}"
            )
        if self._progress is not None:
            self._progress()
        return found
