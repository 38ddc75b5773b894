"""Calibration speed: SciPy and tofcorr side by side on the same arrays.

python -m benchmarks.estimation [--repeats 5] [--json FILE]
"""

import argparse
import json
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from scipy.optimize import least_squares
from torch import Tensor

from benchmarks.scene import camera_of, frames_in_memory, write_vga
from tofcorr.data.recording import FrameBatch
from tofcorr.error_terms.base import Domain
from tofcorr.error_terms.model import ErrorModel, ErrorModelOptions
from tofcorr.estimation.accumulator import Design, MomentAccumulator
from tofcorr.estimation.moments import ImageMoments, MomentObjective, Parameters
from tofcorr.estimation.solvers import Solution, initial_parameters, minimise
from tofcorr.estimation.uncertainty import bootstrap, draw_block_weights, jackknife_covariance
from tofcorr.geometry import se3
from tofcorr.geometry.rays import ray_directions
from tofcorr.options import load_options
from tofcorr.training.options import TrainingOptions

CONFIGS = Path(__file__).resolve().parents[1] / "configs" / "train"
NUM_FOLDS = 6
NUM_RESAMPLES = 1000


def model_options(name: str) -> ErrorModelOptions:
    """Return the terms of a shipped model."""
    return load_options(TrainingOptions, CONFIGS / f"{name}.yaml").model


def ours(
    batch: FrameBatch, domain: Domain, options: ErrorModelOptions
) -> tuple[ImageMoments, Solution]:
    """Arrays in memory to converged parameters with covariance."""
    rays = ray_directions(camera_of(domain.height, domain.width))
    moments = MomentAccumulator(Design(ErrorModel(options, domain), domain, rays))(batch)
    solution = minimise(MomentObjective(moments), initial_parameters(moments))
    jackknife_covariance(moments, solution.parameters)
    return moments, solution


def folds_and_bootstrap(batch: FrameBatch, domain: Domain, generator: torch.Generator) -> None:
    """Six folds of three models, held-out errors, and a bootstrap of 1000 image resamples."""
    count = len(batch.indices)
    order = torch.randperm(count, generator=generator)
    for name in ("e0", "ea", "eb"):
        moments, whole = ours(batch, domain, model_options(name))
        for held_out in order.chunk(NUM_FOLDS):
            kept = torch.ones(count, dtype=torch.bool)
            kept[held_out] = False
            fold = minimise(MomentObjective(moments.images(kept)), whole.parameters)
            MomentObjective(moments.images(held_out)).image_losses(fold.parameters)
        if name == "ea":
            weights = draw_block_weights(torch.arange(count), NUM_RESAMPLES, generator)
            bootstrap(moments, whole.parameters, weights)


def timed(work: dict[str, Callable[[], object]], repeats: int) -> dict[str, list[float]]:
    """Time each job in turn, round after round, so that all see the same machine."""
    seconds: dict[str, list[float]] = {name: [] for name in work}
    for job in work.values():
        job()
    for _ in range(repeats):
        for name, job in work.items():
            start = time.perf_counter()
            job()
            seconds[name].append(time.perf_counter() - start)
    return seconds


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


def compare(repeats: int) -> dict[str, object]:
    """Run both on 62 frames of 50 x 64 pixels."""
    batch, domain = frames_in_memory(62, camera_of(50, 64), torch.Generator().manual_seed(1))
    rays, options = ray_directions(camera_of(50, 64)), model_options("ea")
    moments, solution = ours(batch, domain, options)
    start, error = initial_parameters(moments), ErrorModel(options, domain)
    loss, transform, note = scipy_fit(batch, error, rays, start)
    apart = 1e3 * float((solution.parameters.tool_from_camera - transform)[:3, 3].norm())
    off = abs(loss / solution.loss - 1)
    resampling = torch.Generator().manual_seed(2)
    seconds = timed(
        {
            "tofcorr": lambda: ours(batch, domain, options),
            "scipy lm, analytic jacobian": lambda: scipy_fit(batch, error, rays, start),
            "tofcorr, 6 folds x 3 models + 1000 resamples": lambda: folds_and_bootstrap(
                batch, domain, resampling
            ),
        },
        repeats,
    )
    base = np.median(seconds["tofcorr"])
    rows = {
        name: {
            "ms": _spread([1e3 * spent for spent in times]),
            "ratio": _spread([float(spent / base) for spent in times]),
        }
        for name, times in seconds.items()
    }
    agreement = f"loss {off:.1e} relative, hand-eye {apart:.1e} mm apart; {note}"
    return {"pixels": int(batch.valid.sum()), "rows": rows, "agreement": agreement}


SCALE_PROGRAM = """
import json, sys, time
import torch, numpy as np
from benchmarks.estimation import model_options
from tofcorr.data.recording import Recording
from tofcorr.pixels.dataset import Dataset
from tofcorr.pixels.dataset import covered_domain
from tofcorr.fit.problem import build_model
def status(key):  # the kernel's own count: getrusage would hand on the peak of the parent process
    with open("/proc/self/status") as lines:
        return next(int(line.split()[1]) for line in lines if line.startswith(key))
baseline = status("VmRSS")
start = time.perf_counter()
dataset = Dataset((Recording.open(sys.argv[1]),))
frames = np.arange(int(sys.argv[2]))
_, design = build_model(dataset, model_options("ea"), covered_domain(dataset, frames))
moments = dataset.moments(design, frames)
seconds = time.perf_counter() - start
peak = status("VmHWM")
print(json.dumps({"seconds": seconds, "pixels": float(moments.count.sum()),
                  "above_baseline_mb": (peak - baseline) / 1024}))
"""


def scale(num_frames: int, repeats: int) -> dict[str, object]:
    """Read VGA frames from disk: pixels a second, memory, and growth with the frames."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "vga"
        write_vga(path, num_frames)
        runs: dict[int, list[dict[str, float]]] = {num_frames // 2: [], num_frames: []}
        # The two sizes take turns, each in a process of its own, so that both see the same machine.
        for _ in range(repeats):
            for frames, done in runs.items():
                done.append(_read_and_sum(path, frames))
    half, whole = runs.values()
    seconds = [run["seconds"] for run in whole]
    growth = [b["seconds"] / a["seconds"] for a, b in zip(half, whole, strict=True)]
    speeds = [run["pixels"] / run["seconds"] / 1e6 for run in whole]
    return {
        "frames": num_frames,
        "million_pixels_a_second": _spread(speeds),
        "seconds": _spread(seconds),
        "above_baseline_mb": max(run["above_baseline_mb"] for run in whole),
        "twice_the_frames_takes": _spread(growth),
    }


def _read_and_sum(recording: Path, frames: int) -> dict[str, float]:
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", SCALE_PROGRAM, str(recording), str(frames)],
        capture_output=True,
        text=True,
        check=True,
    )
    return json.loads(done.stdout)


def _spread(values: list[float]) -> list[float]:
    """Return minimum, median and maximum."""
    return [float(f(values)) for f in (np.min, np.median, np.max)]


def main() -> None:
    """Run, print and write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--scale-frames", type=int, default=200)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    result = compare(arguments.repeats)
    result["scale"] = scale(arguments.scale_frames, arguments.repeats)
    result["machine"] = (
        f"{platform.processor() or platform.machine()}, {torch.get_num_threads()} threads"
    )
    print(f"62 x 50 x 64 pixels, EA ({result['machine']})")
    for name, row in result["rows"].items():  # type: ignore[union-attr]
        low, middle, high = row["ratio"]
        print(f"{name:<46}{row['ms'][1]:9.1f} ms  x{middle:7.2f} [{low:.2f}, {high:.2f}]")
    print(result["agreement"])
    print(f"vga, from disk ([min, median, max]): {result['scale']}")
    if arguments.json:
        arguments.json.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
