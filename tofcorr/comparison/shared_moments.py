"""The moments of several error models from as few passes over the pixels as possible.

Models that share masks and weights share a pass: it sums the columns of all their terms, and each
model then takes its own columns.
"""

from collections.abc import Mapping

import numpy as np

from tofcorr.error_terms.domain import Domain
from tofcorr.error_terms.model import ErrorModel
from tofcorr.error_terms.model_options import ErrorModelOptions
from tofcorr.error_terms.registry import TermOptions
from tofcorr.estimation.moments import ImageMoments
from tofcorr.fit.inputs import build_model, refuse_missing_inputs
from tofcorr.pixels.dataset import Dataset, Weighting


def moments_of_models(
    dataset: Dataset,
    models: Mapping[str, ErrorModelOptions],
    domain: Domain,
    device: str = "cpu",
    *,
    frames: np.ndarray | None = None,
    weighting: Weighting | None = None,
) -> dict[str, ImageMoments]:
    """Return the moments of the frames for each model.

    Args:
        dataset: The recordings, with the masks that all models share.
        models: The models by name.
        domain: The ranges that scale their variables.
        device: Where the passes run.
        frames: Global numbers of the frames, in the order wanted; None: all.
        weighting: How much each pixel counts, the same for all models; None: all alike.

    Raises:
        CalibrationDataError: A model needs what a recording lacks.
    """
    for model in models.values():
        refuse_missing_inputs(dataset, model)
    found: dict[str, ImageMoments] = {}
    for together in _groups(models, domain):
        _, design = build_model(dataset, _union([models[name] for name in together]), domain)
        moments = dataset.moments(design, frames, weighting, device)
        for name in together:
            symbols = ErrorModel(models[name], domain).image_symbols()
            found[name] = moments.columns(symbols)
    return {name: found[name] for name in models}


def _groups(models: Mapping[str, ErrorModelOptions], domain: Domain) -> list[list[str]]:
    """Group the models so that in a group no symbol names two different functions."""
    groups: list[list[str]] = []
    for name, model in models.items():
        for group in groups:
            if _contains_all([*(models[other] for other in group), model], domain):
                group.append(name)
                break
        else:
            groups.append([name])
    return groups


def _contains_all(models: list[ErrorModelOptions], domain: Domain) -> bool:
    symbols = ErrorModel(_union(models), domain).image_symbols()
    own = {symbol for model in models for symbol in ErrorModel(model, domain).image_symbols()}
    return len(set(symbols)) == len(symbols) and own <= set(symbols)


def _union(models: list[ErrorModelOptions]) -> ErrorModelOptions:
    """Return every term once; of a nested family, such as degrees of a polynomial, the largest."""
    largest: dict[str, TermOptions] = {}
    for term in (term for model in models for term in model.terms):
        key = term.family()
        if key not in largest or term.size_in_family() > largest[key].size_in_family():
            largest[key] = term
    columns = [term for term in largest.values() if term.has_columns]
    return ErrorModelOptions(terms=tuple(columns))
