"""`reference.json` of a run: what `tofcorr check` needs to know of the calibration's own frames."""

import json
from hashlib import sha256
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from tofcorr.correction.state import CalibrationState
from tofcorr.errors import CalibrationDataError
from tofcorr.fit.reference.form_functions import SHAPES
from tofcorr.fit.reference.reference import Reference, num_unknowns
from tofcorr.fit.reference.views import VIEW

REFERENCE_FILE = "reference.json"
"""Its name in a run folder."""

_FORMAT, _VERSION = "tofcorr-reference", 2
# Largest file that is read, bytes: a hundred times that of the largest shipped model.
_LARGEST = 200_000_000


def save_reference(path: Path, reference: Reference, state: CalibrationState) -> None:
    """Write a reference as JSON, with the coefficients that it belongs to."""
    values = {
        "format": _FORMAT,
        "version": _VERSION,
        "coefficients": state.coefficients.tolist(),
        "mean": reference.mean.tolist(),
        "covariance": reference.covariance.tolist(),
        "random_variance": reference.random_variance.tolist(),
        "bow_variance": reference.bow_variance,
        "persistence": reference.persistence,
        "poses": reference.poses,
        "noise": None if reference.noise is None else list(reference.noise),
        "scatter": reference.scatter,
        "covariance_within": _listed(reference.covariance_within),
        "views": _listed(reference.views),
    }
    values |= {"sha256": _digest(values)}
    path.write_text(json.dumps(values, allow_nan=False) + "\n", encoding="utf-8")


def load_reference(path: Path, state: CalibrationState) -> Reference | None:
    """Read the reference of a calibration; None where the run has none.

    Args:
        path: The file.
        state: The calibration that it must belong to.

    Raises:
        CalibrationDataError: The file is damaged, or belongs to another calibration.
    """
    if not path.is_file():
        return None
    try:
        return _reference(json.loads(_text(path)), state)
    except (OSError, ValueError, TypeError, KeyError, RecursionError, OverflowError) as error:
        raise CalibrationDataError(
            f"{path}: is damaged, or not of this run ({error}); train again, or remove the file "
            "to check without it."
        ) from None


def _text(path: Path) -> str:
    if path.stat().st_size > _LARGEST:
        raise ValueError("it is far too large")
    return path.read_text(encoding="utf-8")


def _reference(values: Any, state: CalibrationState) -> Reference:  # noqa: ANN401 - any JSON
    if not isinstance(values, dict) or values["format"] != _FORMAT:
        raise ValueError(f"its format is not {_FORMAT}")
    if values["version"] != _VERSION:
        raise ValueError(f"its version is {values['version']}, this package reads {_VERSION}")
    if values["sha256"] != _digest({k: one for k, one in values.items() if k != "sha256"}):
        raise ValueError("it was changed after it was written")
    size = num_unknowns(state)
    of_state = _numbers(values, "coefficients", len(state.coefficients))
    if not torch.equal(of_state, state.coefficients.cpu()):
        raise ValueError("its coefficients are those of another calibration")
    covariance = _covariance(values, "covariance", size)
    persistence = float(_numbers(values, "persistence"))
    if not 0 <= persistence < 1:
        raise ValueError("persistence: expected a number from 0 to below 1")
    poses, noise = values["poses"], values["noise"]
    if type(poses) is not int or not 0 < poses < 10**9:
        raise ValueError("poses: expected a positive whole number")
    if noise is not None:
        a, b, c = _numbers(values, "noise", 3).tolist()
        if min(a, b, c) < 0:
            raise ValueError("noise: expected no negative number")
        noise = (a, b, c)
    # Files of older versions have neither of these.
    views, within = values.get("views"), values.get("covariance_within")
    return Reference(
        mean=_numbers(values, "mean", size),
        covariance=covariance,
        random_variance=_positive(values, "random_variance", 3 + SHAPES),
        bow_variance=float(_positive(values, "bow_variance")),
        persistence=persistence,
        poses=poses,
        noise=noise,
        scatter=float(_positive({"scatter": 1.0} | values, "scatter")),
        covariance_within=None
        if within is None
        else _covariance(values, "covariance_within", size),
        views=None if views is None else _numbers(values, "views", len(views), VIEW),
    )


def _covariance(values: dict[str, Any], key: str, size: int) -> Tensor:
    found = _numbers(values, key, size, size)
    if not torch.allclose(found, found.T) or bool((found.diagonal() < 0).any()):
        raise ValueError(f"{key}: is not one")
    return found


def _listed(values: Tensor | None) -> list[list[float]] | None:
    return None if values is None else values.tolist()


def _digest(values: dict[str, Any]) -> str:
    """Return the digest of all entries; numbers come back from JSON as they were written."""
    return sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()


def _positive(values: dict[str, Any], key: str, *shape: int) -> Tensor:
    found = _numbers(values, key, *shape)
    if not bool((found > 0).all()):
        raise ValueError(f"{key}: expected positive numbers")
    return found


def _numbers(values: dict[str, Any], key: str, *shape: int) -> Tensor:
    found = torch.tensor(values[key], dtype=torch.float64)
    if found.shape != shape:
        raise ValueError(f"{key}: has shape {tuple(found.shape)}, expected {shape}")
    if not bool(found.isfinite().all()):
        raise ValueError(f"{key}: holds a value that is not finite")
    return found
