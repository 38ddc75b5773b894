"""Recordings to be timed: a wall before the shipped simulator's camera, with images of any size."""

from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from tofcorr.data.recording import Recording
from tofcorr.data.writing import RecordingWriter
from tofcorr.options import resolve_options
from tofcorr.simulation.options import SimulatorOptions
from tofcorr.simulation.simulator import simulate


def camera_of(height: int, width: int) -> dict[str, Any]:
    """Return the simulator's keys of a camera with the view of a 50 x 64 one of 90 pixels."""
    focal, middle = 90.0 * width / 64, (width / 2 + 0.2, height / 2 - 0.7)
    matrix = [[focal, 0.0, middle[0]], [0.0, focal, middle[1]], [0.0, 0.0, 1.0]]
    distortion = [-0.08, 0.02, 0.0005, -0.0004, 0.0]
    return {"width": width, "height": height, "K": matrix, "distortion": distortion}


def wall(path: Path, num_frames: int, height: int, width: int) -> Recording:
    """Simulate frames of a checkered wall."""
    changes = {"camera": camera_of(height, width)}
    changes["shots"] = [{"target": "checkerboard", "poses": num_frames}]  # type: ignore[assignment]
    return simulate(resolve_options(SimulatorOptions, "demo").to_mapping() | changes, path)


def write_vga(path: Path, num_frames: int) -> None:
    """Write a recording of VGA frames, eight different ones again and again."""
    with TemporaryDirectory() as folder:
        few = wall(Path(folder) / "few", 8, 480, 640)
        assert few.amplitude is not None
        with RecordingWriter.like(path, few, rows=False) as writer:
            for k in range(num_frames):
                row = replace(few.frames.row(k % 8), timestamp=float(k))
                writer.append(few.depth[k % 8], row=row, amplitude=few.amplitude[k % 8])
