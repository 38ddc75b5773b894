"""Error models that contain several others, so that one pass over the pixels serves many."""

import json
from collections.abc import Mapping

from tofcorr.error_terms.domain import Domain
from tofcorr.error_terms.model import ErrorModel, ErrorModelOptions, TermOptions
from tofcorr.estimation.moments import ImageMoments
from tofcorr.fit.fitting import build_model, refuse_missing_inputs
from tofcorr.pixels.dataset import Dataset


def moments_of_models(
    dataset: Dataset, models: Mapping[str, ErrorModelOptions], domain: Domain, device: str = "cpu"
) -> dict[str, ImageMoments]:
    """Return the moments of all frames for each model, from as few passes as can be.

    Args:
        dataset: The recordings.
        models: The models by name.
        domain: The ranges that scale their variables.
        device: Where the passes run.

    Raises:
        CalibrationDataError: A model needs what a recording lacks.
    """
    for model in models.values():
        refuse_missing_inputs(dataset, model)
    found: dict[str, ImageMoments] = {}
    for together in _joinable(models, domain):
        _, design = build_model(dataset, _union([models[name] for name in together]), domain)
        moments = dataset.moments(design, device=device)
        for name in together:
            symbols = ErrorModel(models[name], domain).image_symbols()
            found[name] = moments.columns(symbols)
    return {name: found[name] for name in models}


def _joinable(models: Mapping[str, ErrorModelOptions], domain: Domain) -> list[list[str]]:
    """Group the models: in a group no symbol names two different functions."""
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
    """Return every term once: of polynomials that differ in degree alone, the highest."""
    highest: dict[str, TermOptions] = {}
    for term in (term for model in models for term in model.terms):
        key = _without_degree(term)
        if key not in highest or getattr(term, "degree", 0) > getattr(highest[key], "degree", 0):
            highest[key] = term
    # A fixed pattern is no column, and may stand but once.
    columns = [term for term in highest.values() if term.kind != "fixed_pattern"]
    return ErrorModelOptions(terms=tuple(columns))


def _without_degree(term: TermOptions) -> str:
    values = term.to_mapping()
    # A spline's degree changes all of its functions, a polynomial's only adds some.
    if term.kind.endswith("polynomial"):
        values.pop("degree")
    return json.dumps(values, sort_keys=True)
