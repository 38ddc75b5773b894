"""A model of a comparison: training options under a name."""

from collections.abc import Mapping
from typing import Any

from pydantic import Field, model_validator

from tofcorr.error_terms.model_options import ErrorModelOptions
from tofcorr.errors import ConfigError
from tofcorr.options import resolve_options
from tofcorr.training.options import TrainingOptions

DECIDED_BY_THE_COMPARISON = ("split", "advice", "device")
"""Training options that a model cannot set: the comparison decides them for all models."""


class ComparedModel(TrainingOptions):
    """One model of a comparison; its keys are those of a training configuration.

    A key that the model leaves out takes the value of the comparison's own key of that name, if
    there is one, and otherwise the default of a training. A key that the model sets replaces that
    value as a whole: `weights: {robust: huber}` has `noise: false`.

    In YAML, `config: ea_robust` starts from a training configuration, shipped or a file: its keys
    count as set by the model, and further keys of the entry replace them.

    Attributes:
        name: The heading of the model's column.
        model: The terms of its error; none: the constant alone.
    """

    name: str = Field(min_length=1)
    model: ErrorModelOptions = ErrorModelOptions()

    @model_validator(mode="before")
    @classmethod
    def _from_training_configuration(cls, values: Any) -> Any:  # noqa: ANN401 - YAML's values
        if not isinstance(values, Mapping):
            return values
        for key in DECIDED_BY_THE_COMPARISON:
            if key in values:
                raise ValueError(
                    f"'{key}' cannot differ from model to model; the comparison decides it for all"
                )
        if "config" not in values:
            return values
        own = {key: value for key, value in values.items() if key != "config"}
        return _keys_set_in(values["config"]) | own


def _keys_set_in(config: Any) -> dict[str, Any]:  # noqa: ANN401 - YAML's value
    """Return the options that a training configuration sets, without those that it leaves out."""
    if not isinstance(config, str):
        raise ConfigError("'config' is the name or the file of a training configuration")
    training = resolve_options(TrainingOptions, config)
    chosen = training.model_fields_set - set(DECIDED_BY_THE_COMPARISON)
    return {name: getattr(training, name) for name in chosen}
