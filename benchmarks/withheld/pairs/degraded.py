"""Ideal frames, degraded by the camera that a diagnosis found, beside what is true of it."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.withheld.fitting import at_other_poses, linearise
from benchmarks.withheld.generator.rigid import Array
from benchmarks.withheld.oracle import counted
from benchmarks.withheld.outcomes import load
from benchmarks.withheld.reading import Data, read

GROSS = 8.0  # errors of more standard deviations of the noise are none of a gap, as in the stages


@dataclass(frozen=True)
class Degraded:
    """Degraded frames of another session, whose poses and conditions the diagnosis never saw.

    Neither side of a gap has noise, so that no floor is taken off. `own_mm` is what the camera
    leaves at the poses of the recording: the last stage, known exactly. `oracle_mm` is what least
    squares leave in the other session if they know the effect but for its strength, and are fitted
    to the recording as well. Pixels count whose distance and amplitude lie within those of the
    recording, a share `covered`: beyond them nothing was measured. `error_of_square` is the
    standard error of the square of the gap, with stations as the unit, mm^2.
    """

    gap_mm: float
    error_of_square: float
    covered: float
    own_mm: float
    oracle_mm: float
    noise_mm: float
    true_noise_mm: float
    missing: float  # share of the pixels on the target
    true_missing: float


def read_degraded(out: Path, name: str, answer: Mapping[str, Any]) -> Degraded | None:
    """Compare a pair's degraded frames with what the camera would measure; None without any."""
    record = json.loads((out / "runs" / f"{name}.json").read_text())
    parts = [out / part / name for part in ("degraded", "expected", "own")]
    if record.get("degrade", {}).get("code") != 0 or not all(part.exists() for part in parts):
        return None
    drawn, predicted, own = (read(part) for part in parts)
    true, sigma = load(out, name, "held_out"), load(out, name, "held_out_sigma")
    real = read(out / "recordings" / name)
    covered = within(predicted, real)
    met = np.where(covered, true, np.nan)
    gap, error = gap_of(predicted.depth - met, sigma, drawn.columns["pose_id"])
    left = np.where(real.valid, own.depth - load(out, name, "expected"), np.nan)
    ideal = replace(predicted, depth=met, valid=np.isfinite(met))
    fields = [
        (load(out, name, f"field_{effect}"), load(out, name, f"held_out_field_{effect}"))
        for effect in answer["sizes_mm"]
    ]
    noise, true_noise = noise_of(drawn.depth - predicted.depth, sigma, true)
    on_target = np.load(out / "degraded" / name / "mask.npy") > 0
    return Degraded(
        gap_mm=gap,
        error_of_square=error,
        covered=float(np.mean(covered[np.isfinite(true)])),
        own_mm=gap_of(left, load(out, name, "sigma"), real.columns["pose_id"])[0],
        oracle_mm=gap_of(oracle_error(real, ideal, fields), sigma, drawn.columns["pose_id"])[0],
        noise_mm=noise,
        true_noise_mm=true_noise,
        missing=float(np.mean(~drawn.valid[on_target])),
        true_missing=float(np.mean(~np.isfinite(true[on_target]))),
    )


def within(other: Data, recording: Data) -> np.ndarray:
    """Which pixels (N, H, W) have a distance and an amplitude that the recording has as well."""
    inside = np.ones(other.depth.shape, dtype=bool)
    for mine, known in (
        (other.depth, recording.depth),
        (other.amplitude, recording.amplitude),
    ):
        if mine is not None and known is not None:
            low, high = known[recording.valid].min(), known[recording.valid].max()
            inside &= (mine >= low) & (mine <= high)
    return inside


def gap_of(error: Array, sigma: Array, station: np.ndarray) -> tuple[float, float]:
    """Root mean square of errors (N, H, W), mm, weighted as the stages of a diagnosis are.

    Returns:
        It, and the standard error of its square, mm^2, with stations as the unit.
    """
    known = np.isfinite(error) & (np.abs(np.nan_to_num(error)) < GROSS * sigma)
    weight = known * counted(sigma)
    squares = (weight * np.nan_to_num(error) ** 2).sum((1, 2))
    _, row = np.unique(station, return_inverse=True)
    total, weights = np.bincount(row, squares), np.bincount(row, weight.sum((1, 2)))
    square = total.sum() / weights.sum()
    spread = np.sqrt(((total - square * weights) ** 2).sum()) / weights.sum()
    return 1e3 * float(np.sqrt(square)), 1e6 * float(spread)


def noise_of(deviation: Array, sigma: Array, true: Array) -> tuple[float, float]:
    """Noise drawn and true noise, RMS in mm, over the pixels that both cameras see."""
    both = np.isfinite(deviation) & np.isfinite(true)
    drawn, expected = (1e3 * float(np.sqrt(np.mean(x[both] ** 2))) for x in (deviation, sigma))
    return drawn, expected


def oracle_error(real: Data, ideal: Data, fields: list[tuple[Array, Array]]) -> Array:
    """Errors (N, H, W) in another session of a fit that has the effects' true fields as columns.

    Args:
        real: The recording that is fitted.
        ideal: The other session, with the true distances as its depth.
        fields: Of each effect, in the recording and in the other session, metres.
    """
    base = linearise(real)
    columns = np.column_stack([base.columns, *(here[real.valid] for here, _ in fields)])
    coefficients = replace(base, columns=columns).coefficients
    there = at_other_poses(base, ideal)
    columns = np.column_stack([there.columns, *(other[ideal.valid] for _, other in fields)])
    error = np.full(ideal.depth.shape, np.nan)
    error[ideal.valid] = columns @ coefficients - there.target
    return error
