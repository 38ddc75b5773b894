"""Recordings without a fault: drawn simulators, the shipped ones, and real ones."""

import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from benchmarks.renewed.real import import_kinect
from tofcorr.data.recording import Recording
from tofcorr.importing.distances import command as distances
from tofcorr.options import resolve_options, shipped_names
from tofcorr.pixels.dataset import Dataset, resolved_planes
from tofcorr.plausibility.examine import examine
from tofcorr.simulation.options import SimulatorOptions
from tofcorr.simulation.simulator import simulate


def drawn_simulator(generator: np.random.Generator) -> dict[str, Any]:
    """Return options of a simulator with small images and everything else drawn."""

    def uniform(low: float, high: float) -> float:
        return float(generator.uniform(low, high))

    def normal(scale: float) -> float:
        return float(generator.normal(0, scale))

    scale = uniform(0.3, 0.6)
    targets = ("white", "checkerboard")
    shots = [{"target": name, "poses": int(generator.integers(5, 20))} for name in targets]
    near, far = uniform(0.4, 0.7), uniform(1.3, 2.5)
    seed = int(generator.integers(1 << 31))
    focal, middle = 90.0 * scale, (32.0 * scale, 25.0 * scale)
    camera = {
        "width": round(64 * scale),
        "height": round(50 * scale),
        "K": [[focal, 0.0, middle[0]], [0.0, focal, middle[1]], [0.0, 0.0, 1.0]],
        "distortion": [normal(0.05), 0.0, 0.0, 0.0, 0.0],
    }
    shots = shots[: int(generator.integers(1, 3))] if shots[0]["poses"] >= 8 else shots
    wave = {"order": 3, "share": uniform(0, 0.006), "phase_deg": uniform(0, 360)}
    delays: dict[str, Any] = {"constant_mm": normal(40), "clock_deviation": normal(0.004)}
    shapes = ("row_slope_mm", "column_slope_mm", "bowl_mm")
    delays["pixel"] = {name: normal(6) for name in shapes} | {"irregular_mm": abs(normal(2))}
    light = {"electrons_at_1m": 10 ** uniform(5.5, 6.5)}
    return {
        "seed": seed,
        "camera": camera,
        "shots": shots,
        "sensor": {"harmonics": [wave], "delays": delays, "light": light},
        "robot": {
            "distance_m": [near, far],
            "farthest_pixel_m": far + 0.5,
            "tilt_deg": uniform(20, 42),
            "repeatability_mm": abs(normal(0.5)),
            "repeatability_mrad": abs(normal(0.5)),
        },
        "hand_eye": {"guess": {"translation_mm": 30.0, "rotation_deg": 5.0}},
    }


def clean_recordings(draws: int, shipped: int, seed: int, folder: Path) -> list[dict[str, Any]]:
    """Return what is said of clean recordings, and the CPU time of looking at each.

    Args:
        draws: Number of simulators drawn.
        shipped: Recordings of each shipped simulator.
        seed: Of all draws.
        folder: Where they are written.
    """
    found = []
    for name, path in tqdm(_recordings(draws, shipped, seed, folder), "clean", disable=None):
        recording = Recording.open(path)
        data = Dataset((recording,))
        data.ray_directions()
        start = time.process_time()
        inspection = examine(data, resolved_planes("auto", [recording]))
        spent = time.process_time() - start
        said = {"stopped": bool(inspection.impossible), "headline": inspection.headline}
        found.append({"name": name, **said, "cpu_s": spent})
    return found


def _recordings(draws: int, shipped: int, seed: int, folder: Path) -> Iterator[tuple[str, Path]]:
    """Yield kind and folder of each."""
    for draw in range(draws):
        options = drawn_simulator(np.random.default_rng([seed, 99, draw]))
        simulate(SimulatorOptions.from_mapping(options, "drawn"), folder / f"drawn_{draw}")
        yield "drawn", folder / f"drawn_{draw}"
    for name in shipped_names("simulate") if shipped else ():
        for draw in range(shipped):
            path = folder / f"{name}_{draw}"
            options = resolve_options(SimulatorOptions, name)
            simulate(options.model_copy(update={"seed": seed + draw}), path)
            yield name, path
    real = os.environ.get("TOFCORR_REAL_DATA")
    if shipped and real is not None:
        yield "Kinect v2", import_kinect(Path(real), folder / "real")
        for trial in sorted((Path(real) / "wall_trials_l3cx").glob("L3CX_*")):
            out = folder / trial.name
            words = [str(trial), "--depth-unit-mm", "1", "--out", str(out)]
            distances.main(words, standalone_mode=False)
            yield trial.name, out
