"""Calibration speed: SciPy and tofcorr side by side on the same arrays.

python -m benchmarks.estimation [--repeats 5] [--json FILE]
"""

import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import click
import numpy as np
import torch
from scipy.optimize import least_squares
from torch import Tensor

from benchmarks.scene import wall, write_vga
from benchmarks.timing import JSON, machine, spread, timed, write
from tofcorr.data.recording import FrameBatch, Recording
from tofcorr.error_terms.model import ErrorModel, ErrorModelOptions
from tofcorr.estimation.accumulator import Design, MomentAccumulator
from tofcorr.estimation.moments import ImageMoments, MomentObjective, Parameters
from tofcorr.estimation.solvers import Solution, initial_parameters, minimise
from tofcorr.estimation.uncertainty import jackknife_covariance
from tofcorr.fit.problem import build_model
from tofcorr.geometry import se3
from tofcorr.options import resolve_options
from tofcorr.pixels.dataset import Dataset
from tofcorr.pixels.lattice import covered_domain
from tofcorr.pixels.passes import image_moments
from tofcorr.training.calibration import TrainingOptions

NUM_FOLDS = 6


def model_options(name: str) -> ErrorModelOptions:
    """Return the terms of a shipped model."""
    return resolve_options(TrainingOptions, name).model


def built(data: Dataset, name: str, num_frames: int | None = None) -> tuple[ErrorModel, Design]:
    """Return a shipped model, and its columns over the domain of some frames."""
    frames = np.arange(num_frames or data.num_frames)
    return build_model(data, model_options(name), covered_domain(data, frames))


def ours(batch: FrameBatch, design: Design) -> tuple[ImageMoments, Solution]:
    """Arrays in memory to converged parameters with covariance."""
    moments = MomentAccumulator(design)(batch)
    solution = minimise(MomentObjective(moments), initial_parameters(moments))
    jackknife_covariance(moments, solution.parameters)
    return moments, solution


def folds(data: Dataset, batch: FrameBatch, generator: torch.Generator) -> None:
    """Six folds of three models, and their held-out errors."""
    count = len(batch.indices)
    order = torch.randperm(count, generator=generator)
    for name in ("e0", "ea", "eb"):
        moments, whole = ours(batch, built(data, name)[1])
        for held_out in order.chunk(NUM_FOLDS):
            kept = torch.ones(count, dtype=torch.bool)
            kept[held_out] = False
            fold = minimise(MomentObjective(moments.images(kept)), whole.parameters)
            MomentObjective(moments.images(held_out)).image_losses(fold.parameters)


def scipy_fit(
    batch: FrameBatch, error: ErrorModel, rays: Tensor, start: Parameters
) -> tuple[float, Tensor, str]:
    """Fit all pixels with `scipy.optimize.least_squares(method="lm")` and the analytic Jacobian.

    Returns:
        Sum of squared residuals, tool_from_camera (4, 4), and how many evaluations it took.
    """
    frame, row, column = torch.nonzero(batch.valid, as_tuple=True)
    distance = batch.radial_distance[batch.valid]
    amplitude = distance if batch.amplitude is None else batch.amplitude[batch.valid]
    with torch.no_grad():
        signal = [term.basis(distance, amplitude) for term in error.signal_terms]  # type: ignore[operator]
        pixel = [term.basis(row.double(), column.double()) for term in error.pixel_terms]  # type: ignore[operator]
    basis = torch.cat([torch.ones_like(distance)[None], *signal, *pixel]).T.contiguous().numpy()
    ray, measured, image = rays[row, column].numpy(), distance.numpy(), frame.numpy()
    normal, offset = batch.normal_tool.numpy(), batch.offset_tool.numpy()

    def moved(x: np.ndarray) -> np.ndarray:
        return start.tool_from_camera.numpy() @ se3.exp(torch.from_numpy(x[:6].copy())).numpy()

    def residual(x: np.ndarray) -> np.ndarray:
        transform = moved(x)
        cosine = np.einsum("vk,vk->v", ray, (normal @ transform[:3, :3])[image])
        return cosine * (measured - basis @ x[6:]) + (normal @ transform[:3, 3] + offset)[image]

    def jacobian(x: np.ndarray) -> np.ndarray:
        turn, facing = _body_derivative(x[:6]), (normal @ moved(x)[:3, :3])[image]
        lever = np.cross(ray * (measured - basis @ x[6:])[:, None], facing)
        cosine = np.einsum("vk,vk->v", ray, facing)
        return np.hstack([facing @ turn[:3] + lever @ turn[3:], -cosine[:, None] * basis])

    x0 = np.concatenate([np.zeros(6), start.coefficients.numpy()])
    exact = {"x_scale": "jac", "ftol": 1e-15, "xtol": 1e-12, "gtol": 1e-15}
    # SciPy's stubs know no callable Jacobian.
    found = least_squares(residual, x0, jacobian, method="lm", **exact)  # type: ignore[arg-type]
    return 2 * found.cost, torch.from_numpy(moved(found.x)), f"{found.nfev} evaluations"


def _body_derivative(twist: np.ndarray) -> np.ndarray:
    """Return the body-frame derivative D with exp(x + d) = exp(x) exp(D d), (6, 6)."""
    x = torch.from_numpy(twist.copy())
    back = se3.inverse(se3.exp(x))

    def body(y: Tensor) -> Tensor:
        moved = back @ se3.exp(y)
        return torch.cat([moved[:3, 3], moved[[2, 0, 1], [1, 2, 0]]])

    return torch.autograd.functional.jacobian(body, x).numpy()  # type: ignore[union-attr]


def compare(path: Path, repeats: int) -> dict[str, Any]:
    """Run both on 62 frames of 50 x 64 pixels."""
    data = Dataset((wall(path, 62, 50, 64),))
    (batch,) = data.batches(chunk_pixels=2**20)
    model, design = built(data, "ea")
    moments, solution = ours(batch, design)
    fitted = (batch, model, data.ray_directions(), initial_parameters(moments))
    loss, transform, note = scipy_fit(*fitted)
    apart = 1e3 * float((solution.parameters.tool_from_camera - transform)[:3, 3].norm())
    off = abs(loss / solution.loss - 1)
    draws = torch.Generator().manual_seed(2)
    jobs = {
        "tofcorr": lambda: ours(batch, design),
        "scipy lm, analytic jacobian": lambda: scipy_fit(*fitted),
        "tofcorr, 6 folds x 3 models": lambda: folds(data, batch, draws),
    }
    seconds = {name: np.array(times) for name, times in timed(jobs, repeats).items()}
    base = np.median(seconds["tofcorr"])
    rows = {
        name: {"ms": spread(1e3 * times), "ratio": spread(times / base)}
        for name, times in seconds.items()
    }
    agreement = f"loss {off:.1e} relative, hand-eye {apart:.1e} mm apart; {note}"
    return {"pixels": int(batch.valid.sum()), "rows": rows, "agreement": agreement}


def scale(path: Path, num_frames: int, repeats: int) -> dict[str, object]:
    """Read VGA frames from disk: pixels a second, memory, and growth with the frames."""
    sizes = (num_frames // 2, num_frames)
    context = get_context("spawn")
    write_vga(path, num_frames)
    # The two sizes take turns, each in a process of its own, so that both see the same machine.
    with ProcessPoolExecutor(1, context, max_tasks_per_child=1) as pool:
        runs = list(pool.map(read_and_sum, [path] * 2 * repeats, sizes * repeats))
    half, whole = np.array(runs[::2]), np.array(runs[1::2])
    return {
        "frames": num_frames,
        "million_pixels_a_second": spread(whole[:, 1] / whole[:, 0] / 1e6),
        "seconds": spread(whole[:, 0]),
        "above_baseline_mb": float(whole[:, 2].max()),
        "twice_the_frames_takes": spread(whole[:, 0] / half[:, 0]),
    }


def read_and_sum(path: Path, num_frames: int) -> tuple[float, float, float]:
    """Return seconds and pixels of a pass over a recording, and the memory it took, MiB."""
    baseline, start = _status("VmRSS"), time.perf_counter()
    data = Dataset((Recording.open(path),))
    design = built(data, "ea", num_frames)[1]
    pixels = float(image_moments(data, design, range(num_frames)).count.sum())
    return time.perf_counter() - start, pixels, (_status("VmHWM") - baseline) / 1024


def _status(key: str) -> int:
    """The kernel's own count, KiB: getrusage would hand on the peak of the parent process."""
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith(key))


@click.command()
@click.option("--repeats", default=5, show_default=True)
@click.option("--scale-frames", default=200, show_default=True, help="VGA frames read from disk.")
@JSON
def main(repeats: int, scale_frames: int, out: Path | None) -> None:
    """Compare the speed of SciPy and tofcorr on the same arrays."""
    with tempfile.TemporaryDirectory() as folder:
        result = compare(Path(folder) / "wall", repeats)
        result["scale"] = scale(Path(folder) / "vga", scale_frames, repeats)
    result["machine"] = machine()
    click.echo(f"62 x 50 x 64 pixels, EA ({result['machine']})")
    for name, row in result["rows"].items():
        low, middle, high = row["ratio"]
        click.echo(f"{name:<46}{row['ms'][1]:9.1f} ms  x{middle:7.2f} [{low:.2f}, {high:.2f}]")
    click.echo(result["agreement"])
    click.echo(f"vga, from disk ([min, median, max]): {result['scale']}")
    write(result, out)


if __name__ == "__main__":
    main()
