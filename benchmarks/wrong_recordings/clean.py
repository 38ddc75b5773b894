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
from tofcorr.data.table import FrameRow
from tofcorr.data.writing import write_recording
from tofcorr.geometry.camera import CameraIntrinsics
from tofcorr.options import resolve_options, shipped_names
from tofcorr.pixels.dataset import Dataset, resolved_planes
from tofcorr.plausibility.examine import examine
from tofcorr.simulation.options import SimulatorOptions
from tofcorr.simulation.simulator import simulate

# The ray of a single pixel is the optical axis.
_ONE_PIXEL = CameraIntrinsics(
    width=1, height=1, matrix=((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
)


def drawn_simulator(generator: np.random.Generator) -> dict[str, Any]:
    """Return options of a simulator with small images and everything else drawn."""
    scale = float(generator.uniform(0.3, 0.6))
    shots = [{"target": "white", "poses": int(generator.integers(5, 20))}]
    shots.append({"target": "checkerboard", "poses": int(generator.integers(5, 20))})
    near = float(generator.uniform(0.4, 0.7))
    far = float(generator.uniform(1.3, 2.5))
    return {
        "seed": int(generator.integers(1 << 31)),
        "camera": {
            "width": round(64 * scale),
            "height": round(50 * scale),
            "K": [
                [90.0 * scale, 0.0, 32.0 * scale],
                [0.0, 90.0 * scale, 25.0 * scale],
                [0.0, 0.0, 1.0],
            ],
            "distortion": [float(generator.normal(0, 0.05)), 0.0, 0.0, 0.0, 0.0],
        },
        "shots": shots[: int(generator.integers(1, 3))] if shots[0]["poses"] >= 8 else shots,
        "sensor": {
            "harmonics": [
                {
                    "order": 3,
                    "share": float(generator.uniform(0, 0.006)),
                    "phase_deg": float(generator.uniform(0, 360)),
                }
            ],
            "delays": {
                "constant_mm": float(generator.normal(0, 40)),
                "clock_deviation": float(generator.normal(0, 0.004)),
                "pixel": {
                    "row_slope_mm": float(generator.normal(0, 6)),
                    "column_slope_mm": float(generator.normal(0, 6)),
                    "bowl_mm": float(generator.normal(0, 6)),
                    "irregular_mm": float(abs(generator.normal(0, 2))),
                },
            },
            "light": {"electrons_at_1m": float(10 ** generator.uniform(5.5, 6.5))},
        },
        "robot": {
            "distance_m": [near, far],
            "farthest_pixel_m": far + 0.5,
            "tilt_deg": float(generator.uniform(20, 42)),
            "repeatability_mm": float(abs(generator.normal(0, 0.5))),
            "repeatability_mrad": float(abs(generator.normal(0, 0.5))),
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
    with tqdm(desc="clean", unit="recording", disable=None) as bar:
        for name, path in _recordings(draws, shipped, seed, folder):
            recording = Recording.open(path)
            data = Dataset((recording,))
            data.ray_directions()
            start = time.process_time()
            inspection = examine(data, resolved_planes("auto", [recording]))
            found.append(
                {
                    "name": name,
                    "stopped": bool(inspection.impossible),
                    "headline": inspection.headline,
                    "cpu_s": time.process_time() - start,
                }
            )
            bar.update()
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
            yield trial.name, _write_trial(trial, folder / trial.name)


def _write_trial(trial: Path, out: Path) -> Path:
    """Write a robot's poses and the distances of a single pixel; nobody measured the wall."""
    poses = np.loadtxt(trial / "transforms.csv", delimiter=",", usecols=range(16))
    lines = (trial / "measurements.csv").read_text(encoding="utf-8").splitlines()
    readings = [[float(cell) for cell in line.split(",")[1:] if cell.strip()] for line in lines]
    rows = []
    for number, pose in enumerate(poses.reshape(-1, 4, 4)):
        left, _, right = np.linalg.svd(pose[:3, :3])
        pose[:3, :3] = left @ right  # The file has it to six digits.
        wall = np.array([0.0, 0.0, -1.0])
        rows.append(
            FrameRow(
                timestamp=float(number),
                world_from_tool=pose,
                normal_world=wall,
                offset=1.0,
                target="wall",
            )
        )
    depth = np.array([[[np.median(one) / 1e3]] for one in readings])
    write_recording(
        out, camera=_ONE_PIXEL, depth_kind="radial", rows=rows, depth=depth, planes="estimated"
    )
    return out
