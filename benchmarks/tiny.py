"""The smallest recording that everything can be done with, and what is made from it."""

from pathlib import Path
from typing import Any

import numpy as np

import tofcorr
from benchmarks.wrong_recordings.parts import Parts
from tofcorr.options import resolve_options
from tofcorr.simulation.options import SimulatorOptions
from tofcorr.simulation.simulator import simulate
from tofcorr.training.calibration import TrainingOptions
from tofcorr.training.run import train

CONFIG: dict[str, Any] = {
    "camera": {
        "width": 12,
        "height": 10,
        "K": [[17.0, 0.0, 6.0], [0.0, 17.0, 4.8], [0.0, 0.0, 1.0]],
        "distortion": [-0.08, 0.02, 0.0005, -0.0004, 0.0],
    },
    "shots": [{"target": "white", "poses": 8}, {"target": "checkerboard", "poses": 10}],
}
"""What differs from the shipped simulator `demo`."""


def simulator(seed: int) -> dict[str, Any]:
    """Return the keys and values of the simulator of a tiny recording."""
    return resolve_options(SimulatorOptions, "demo").to_mapping() | CONFIG | {"seed": seed}


def make(folder: Path, seed: int) -> Path:
    """Write valid files of the formats that tofcorr reads and writes itself into a folder.

    Files that are there already are taken.

    Args:
        folder: It gets `recording`, with amplitude, mask and truth; `full`, its first frames with
            every optional array; `run`, what `tofcorr train` made of it; `module.pt`, a file of
            `DepthCorrection.save`; `corrector.npz`, a look-up table; and `sensor.yaml`.
        seed: Of all draws.

    Returns:
        The folder.
    """
    if (folder / "sensor.yaml").exists():
        return folder
    options = SimulatorOptions.from_mapping(simulator(seed), "tiny")
    simulate(options, folder / "recording")
    _write_full(folder / "recording", folder / "full", seed)
    training = resolve_options(TrainingOptions, "ea", ("figures=false", "advice=0"))
    train(folder / "recording", training, out=folder / "run", force=True)
    module = tofcorr.DepthCorrection.load(folder / "run")
    module.save(folder / "module.pt")
    module.export("lut", folder / "corrector.npz")
    tofcorr.SensorModel.load("kinect_v2").save(folder / "sensor.yaml")
    return folder


def _write_full(recording: Path, path: Path, seed: int) -> None:
    few, generator = Parts.read(recording).frames(slice(0, 6)), np.random.default_rng(seed)
    mask, limits = generator.uniform(size=few.depth.shape) > 0.2, {"saturation_amplitude": 60_000.0}
    few.changed(mask=mask, **limits).write(path)
    raw = generator.normal(size=(6, 4, *few.depth.shape[1:]))
    np.save(path / "raw.npy", raw.astype(np.float32))
    # With pose ids and conditions.
    lines = (recording / "frames.csv").read_text(encoding="utf-8").splitlines(keepends=True)
    (path / "frames.csv").write_text("".join(lines[:7]), encoding="utf-8")
