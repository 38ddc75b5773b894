"""The models that evaluations of a synthetic scene compare."""

from typing import Any

from synthetic_scene import E0, EA, EB

from tofcorr.comparison.options import EvaluationOptions

MODELS = [{"name": name, "model": model} for name, model in (("E0", E0), ("EA", EA), ("EB", EB))]


def options(*models: dict[str, Any], **changes: Any) -> EvaluationOptions:
    values = {"models": list(models) or MODELS, "folds": 4} | changes
    return EvaluationOptions.from_mapping(values, "test")
