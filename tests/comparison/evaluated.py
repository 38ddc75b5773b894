"""The models that evaluations of a synthetic scene compare."""

from typing import Any

from synthetic_scene import E0, EA, EB

from tofcorr.comparison.experiment import Experiment, compare
from tofcorr.comparison.options import EvaluationOptions
from tofcorr.pixels.dataset import Dataset

MODELS = [{"name": name, "model": model} for name, model in (("E0", E0), ("EA", EA), ("EB", EB))]


def options(*models: dict[str, Any], **changes: Any) -> EvaluationOptions:
    values = {"models": list(models) or MODELS, "folds": 4} | changes
    return EvaluationOptions.from_mapping(values, "test")


def compared(name: str, dataset: Dataset, asked: EvaluationOptions) -> Experiment:
    """Return the experiment with every column measured."""
    found = Experiment(name, dataset, asked)
    compare([found])
    return found
