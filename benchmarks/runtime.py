"""Runtime speed: corrector.ts, .pt2 and .c beside one torch.add and NumPy, on the same frames.

The C is compiled for this processor (-O3 -march=native -fopenmp) and for any (-O3 -fopenmp).
It runs as many threads as torch.

python -m benchmarks.runtime [--repeats 30] [--json FILE]
"""

import tempfile
from collections.abc import Callable, Iterable
from itertools import cycle
from pathlib import Path
from typing import Any

import click
import numpy as np
import torch

from benchmarks.estimation import model_options
from benchmarks.scene import camera_of
from benchmarks.timing import JSON, Seconds, machine, spread, timed, write
from tofcorr.correction.corrector import DepthCorrector
from tofcorr.correction.export.c import export_c, load_c
from tofcorr.correction.export.pt2 import export_pt2, load_pt2
from tofcorr.correction.export.torchscript import export_torchscript
from tofcorr.correction.state import CalibrationState
from tofcorr.error_terms.base import Domain, Interval
from tofcorr.simulation.options import CameraOptions

# Height, width, frames that follow one another.
CASES = ((50, 64, 8), (172, 224, 8), (480, 640, 8), (1024, 1024, 8), (480, 640, 1))
COEFFICIENTS = (0.02, 0.01, -0.006, 0.002, 0.004, -0.001, 0.001, 0.003, -0.001, 0.002)


def calibration(height: int, width: int) -> CalibrationState:
    """Return an EA calibration of a camera of this size."""
    amplitudes = dict.fromkeys(("amplitude", "normalised_amplitude"), Interval(10.0, 900.0))
    distances = Interval(0.5, 2.0)
    domain = Domain(height=height, width=width, radial_distance=distances, **amplitudes)
    return CalibrationState(
        name="EA",
        error_model=model_options("ea"),
        domain=domain,
        coefficients=torch.tensor(COEFFICIENTS, dtype=torch.float64),
        tool_from_camera=torch.eye(4, dtype=torch.float64),
        hand_eye_estimated=True,
        camera=CameraOptions(**camera_of(height, width)).intrinsics(),
        depth_kind="radial",
    )


def numpy_corrector(
    state: CalibrationState,
) -> Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]:
    """Write the same correction in NumPy, as a user would who has the coefficients."""
    domain, amplitude_range = state.domain, state.domain.amplitude
    assert amplitude_range is not None
    offset = state.model().error.pixel_error().detach().numpy().astype(np.float32)
    c1, c2, c3, i1, i2 = np.array(COEFFICIENTS[1:6], np.float32)
    near, far, weak, strong = np.array([*domain.radial_distance, *amplitude_range], np.float32)
    d_mid, d_half = np.float32((near + far) / 2), np.float32((far - near) / 2)
    a_mid, a_half = np.float32((weak + strong) / 2), np.float32((strong - weak) / 2)

    def correct(depth: np.ndarray, amplitude: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        held, strength = np.clip(depth, near, far), np.clip(amplitude, weak, strong)
        u, a = (held - d_mid) / d_half, (strength - a_mid) / a_half
        error = offset + ((c3 * u + c2) * u + c1) * u + (i2 * a + i1) * a
        corrected = np.where(depth > 0, depth - error, np.float32(np.nan))
        return corrected, (held == depth) & (strength == amplitude)

    return correct


def compare(height: int, width: int, repeats: int, folder: Path, num_frames: int) -> Seconds:
    """Return seconds a frame of each job, round after round, so that all see the same machine.

    Args:
        height: Of the camera.
        width: Of the camera.
        repeats: Rounds.
        folder: For the exports.
        num_frames: Frames that follow one another. A camera never gives the same frame twice: with
            several, frames come from outside the caches; one alone stays inside.
    """
    state = calibration(height, width)
    corrector = DepthCorrector.from_state(state)
    export_torchscript(corrector, folder / "corrector.ts", state)
    export_pt2(corrector, folder / "corrector.pt2", state)
    export_c(corrector, folder / "corrector.c", state)
    compiled = {
        f".c{name}": load_c(folder / "corrector.c", ("-O3", "-fopenmp", *more))
        for name, more in (("", ("-march=native",)), (" any", ()))
    }
    script, package = torch.jit.load(folder / "corrector.ts"), load_pt2(folder / "corrector.pt2")
    generator = torch.Generator().manual_seed(0)
    draws = torch.rand(num_frames, 2, height, width, generator=generator)
    frames = [(0.6 + 1.3 * depth, 20 + 800 * amplitude) for depth, amplitude in draws]
    arrays = [(depth.numpy(), amplitude.numpy()) for depth, amplitude in frames]
    out, in_numpy = torch.empty_like(frames[0][0]), numpy_corrector(state)
    for job in (script, *compiled.values()):
        expected = torch.from_numpy(in_numpy(*arrays[0])[0])
        torch.testing.assert_close(job(*frames[0])[0], expected, rtol=0, atol=1e-6, equal_nan=True)
    jobs: dict[str, Callable[[], object]] = {
        "torch.add": _stream(lambda depth, amplitude: torch.add(depth, amplitude, out=out), frames),
        "corrector.ts": _stream(script, frames),
        "corrector.pt2": _stream(package, frames),
        **{name: _stream(job, frames) for name, job in compiled.items()},
        "numpy": _stream(in_numpy, arrays),
    }
    with torch.no_grad():
        return timed(jobs, repeats, warm_up=3, in_a_row=8)


def _stream(job: Callable[..., object], frames: Iterable[tuple]) -> Callable[[], object]:
    """Return a job that takes the next frame at every call."""
    coming = cycle(frames)
    return lambda: job(*next(coming))


@click.command()
@click.option("--repeats", default=30, show_default=True)
@JSON
def main(repeats: int, out: Path | None) -> None:
    """Compare the speed of the runtime corrector with torch.add and NumPy."""
    result: dict[str, Any] = {"machine": machine()}
    click.echo(f"times one torch.add of the same frames: median [min, max] ({machine()})")
    for height, width, num_frames in CASES:
        with tempfile.TemporaryDirectory() as folder:
            seconds = compare(height, width, repeats, Path(folder), num_frames)
        base = float(np.median(seconds["torch.add"]))
        what = "a stream" if num_frames > 1 else "one frame again and again"
        line = [f"{height:>5} x {width:<5} {what:<26} add {1e3 * base:.3f} ms"]
        for name in list(seconds)[1:]:
            low, middle, high = (time / base for time in spread(seconds[name]))
            line.append(f"{name} {middle:5.1f} [{low:.1f}, {high:.1f}]")
        click.echo("   ".join(line))
        result[f"{height}x{width}, {what}"] = {
            name: [1e3 * time for time in spread(times)] for name, times in seconds.items()
        }
    write(result, out)


if __name__ == "__main__":
    main()
