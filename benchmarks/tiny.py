"""The smallest recording that everything can be done with, and what is made from it."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import tofcorr
from tofcorr.data.recording import Recording
from tofcorr.data.writing import write_recording
from tofcorr.options import resolve_options
from tofcorr.simulation.options import SimulatorOptions
from tofcorr.simulation.simulator import simulate
from tofcorr.training.options import TrainingOptions
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


@dataclass(frozen=True, kw_only=True)
class Tiny:
    """Valid files of the formats that tofcorr reads and writes itself.

    Attributes:
        recording: With amplitude, mask and truth.
        full: Its first frames, with every optional array.
        run: What `tofcorr train` made of it.
        module: A file of `DepthCorrection.save`.
        lut: A look-up table.
        sensor: A `sensor.yaml`.
    """

    recording: Path
    full: Path
    run: Path
    module: Path
    lut: Path
    sensor: Path


def simulator(seed: int) -> dict[str, Any]:
    """Return the keys and values of the simulator of a tiny recording."""
    return resolve_options(SimulatorOptions, "demo").to_mapping() | CONFIG | {"seed": seed}


def make(folder: Path, seed: int) -> Tiny:
    """Write all of it into a folder; what is there already is taken."""
    made = Tiny(
        recording=folder / "recording",
        full=folder / "full",
        run=folder / "run",
        module=folder / "module.pt",
        lut=folder / "corrector.npz",
        sensor=folder / "sensor.yaml",
    )
    if made.sensor.exists():
        return made
    recording = simulate(SimulatorOptions.from_mapping(simulator(seed), "tiny"), made.recording)
    _write_full(recording, made.full, seed)
    options = resolve_options(TrainingOptions, "ea", ("figures=false", "advice=0"))
    train(made.recording, options, out=made.run, force=True)
    module = tofcorr.DepthCorrection.load(made.run)
    module.save(made.module)
    module.export("lut", made.lut)
    tofcorr.SensorModel.load("kinect_v2").save(made.sensor)
    return made


def _write_full(recording: Recording, path: Path, seed: int) -> None:
    generator = np.random.default_rng(seed)
    shape = (6, recording.camera.height, recording.camera.width)
    depth = np.array(recording.depth[:6])
    write_recording(
        path,
        camera=recording.camera,
        depth_kind=recording.depth_kind,
        rows=list(recording.frames.rows())[:6],
        depth=depth,
        amplitude=None if recording.amplitude is None else np.array(recording.amplitude[:6]),
        mask=(generator.uniform(size=shape) > 0.2).astype(np.uint8),
        raw=generator.normal(size=(6, 4, *shape[1:])).astype(np.float32),
        modulation_frequency=20e6,
        saturation_amplitude=60_000.0,
        tool_from_camera=recording.tool_from_camera,
    )
