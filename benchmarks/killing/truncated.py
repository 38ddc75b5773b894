"""Copies of files that were cut short, as a broken copy leaves them."""

import random
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

import tofcorr
from tofcorr.correction.metadata import load_corrector
from tofcorr.correction.state import load_calibration
from tofcorr.data.recording import Recording
from tofcorr.errors import TofcorrError
from tofcorr.sensor.sensor_file import read_sensor

_TEXTS = (".yaml", ".csv")


def cut_copies(ready: Path, count: int, generator: random.Random) -> tuple[list[str], list[str]]:
    """Cut files at random lengths, and read them.

    Args:
        ready: A workspace with a recording, a run and a sensor.
        count: Number of copies.
        generator: Source of randomness.

    Returns:
        What was read as something else, a sentence each: texts, and binary files.
    """
    copy = ready.parent / "cut"
    shutil.copytree(ready, copy)
    files: dict[Path, Callable[[], Any]] = {
        **{copy / "recording" / name: lambda: _recording(copy / "recording") for name in (
            "recording.yaml", "frames.csv", "depth.npy", "amplitude.npy"
        )},
        copy / "run" / "state.pt": lambda: load_calibration(copy / "run" / "state.pt"),
        copy / "run" / "corrector.ts": lambda: load_corrector(copy / "run" / "corrector.ts")[1],
        copy / "run" / "config.yaml": lambda: tofcorr.DepthCorrection.load(copy / "run").options,
        copy / "sensor.yaml": lambda: read_sensor(copy / "sensor.yaml"),
    }  # fmt: skip
    wanted = {path: _shown(read()) for path, read in files.items()}
    texts: list[str] = []
    binary: list[str] = []
    for _ in range(count):
        path = generator.choice(list(files))
        content = path.read_bytes()
        kept = generator.randrange(len(content))
        if generator.random() < 0.5:  # Near the end, where little is missing.
            kept = len(content) - 1 - generator.randrange(min(60, len(content) - 1))
        path.write_bytes(content[:kept])
        try:
            found = _shown(files[path]())
        except TofcorrError:
            found = wanted[path]
        finally:
            path.write_bytes(content)
        if found != wanted[path]:
            place = texts if path.suffix in _TEXTS else binary
            place.append(f"{path.name} cut to {kept} of {len(content)} bytes was read as another.")
    return texts, binary


def _recording(path: Path) -> tuple[Any, ...]:
    recording = Recording.open(path)
    frames, camera = recording.frames, recording.camera
    return (
        camera,
        recording.tool_from_camera.tolist(),
        recording.saturation_amplitude,
        frames.world_from_tool.tolist(),
        frames.offset.tolist(),
        list(frames.target),
        [None if one is None else np.array(one).tobytes() for one in (frames.pose_id,)],
        [getattr(frames, name) for name in ()],
        float(np.nansum(recording.depth)),
    )


def _shown(value: object) -> str:
    return repr(value)
