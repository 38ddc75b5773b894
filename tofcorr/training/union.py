"""One error model that contains several, so that one pass over the pixels serves them all."""

import json
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from tofcorr.error_terms.domain import Domain
from tofcorr.error_terms.model import ErrorModel, ErrorModelOptions, TermOptions
from tofcorr.errors import ConfigError
from tofcorr.estimation.design import Design
from tofcorr.training.dataset import Dataset
from tofcorr.training.fitting import build_model


@dataclass(frozen=True)
class ModelUnion:
    """The union of several error models on one camera.

    Attributes:
        design: The columns of all models together.
        symbols: Each model's coefficients, by the model's name.
    """

    design: Design
    symbols: dict[str, list[str]]

    def coefficients(self, symbols: list[str], values: Tensor) -> Tensor:
        """Return the coefficients (K,) named as those of the union, zero where it has others."""
        full = torch.zeros(len(self.design.symbols), dtype=torch.float64)
        full[[self.design.symbols.index(symbol) for symbol in symbols]] = values
        return full


def union_of(
    dataset: Dataset, models: Mapping[str, ErrorModelOptions], domain: Domain
) -> ModelUnion:
    """Build the union: of terms that differ in degree alone, the highest contains the others.

    Raises:
        ConfigError: Two models give one coefficient's name to different functions.
        CalibrationDataError: A model needs amplitudes that a recording lacks.
    """
    highest: dict[str, TermOptions] = {}
    for model in models.values():
        for term in model.terms:
            values = term.to_mapping()
            degree = values.pop("degree", 0)
            key = json.dumps(values, sort_keys=True)
            if key not in highest or degree > getattr(highest[key], "degree", 0):
                highest[key] = term
    _, design = build_model(dataset, ErrorModelOptions(terms=tuple(highest.values())), domain)
    symbols = {name: ErrorModel(model, domain).symbols() for name, model in models.items()}
    for name, own in symbols.items():
        missing = [symbol for symbol in own if design.symbols.count(symbol) != 1]
        if missing or len(set(own)) != len(own):
            raise ConfigError(
                f"model {name}: its terms cannot stand beside those of the other models, since "
                f"'{(missing or own)[0]}' would name two different functions; evaluate it in a "
                "configuration of its own."
            )
    return ModelUnion(design, symbols)
