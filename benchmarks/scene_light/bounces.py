"""How much of the squared error of second bounces is removed, on scenes rendered by a third party.

    python -m benchmarks.scene_light.bounces --seed 1

The gain is fitted on walls of other seeds, jointly with the base error; the base error is then
fitted to lone walls whose distance is known. Both are used in the scenes, with noise.
"""

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from benchmarks.scene_light.rooms import (
    CONE,
    FREQUENCY,
    GAIN,
    HEIGHT,
    SCENES,
    WIDTH,
    Frame,
    matrix,
    rays,
    rendered,
)
from tofcorr.geometry.camera import CameraIntrinsics
from tofcorr.scene_light.bounces import SecondBounces, SecondBouncesState
from tofcorr.scene_light.drawn import fit_remainder
from tofcorr.scene_light.gain import fit_gain
from tofcorr.scene_light.remainder import RemainderOptions

NOISE = 3.5e-3  # metres, at the median amplitude of a frame
WALLS = ("wall_and_floor", "wall_and_side")  # the other walls are mostly outside
OTHER_SEED = 1000  # what is added for the scenes of the calibration

Image = np.ndarray


def camera() -> CameraIntrinsics:
    """The camera of the scenes."""
    return CameraIntrinsics(width=WIDTH, height=HEIGHT, matrix=matrix())


def base_error(distance: Image, amplitude: Image) -> Image:
    """What the camera is off besides, metres: by distance and by amplitude."""
    return 0.02 * np.sin(2 * np.pi * distance / 1.87 + 0.4) + 0.004 * np.log(amplitude / 100)


def functions(distance: torch.Tensor, amplitude: torch.Tensor) -> torch.Tensor:
    """The functions that the base error is fitted with: powers, and the logarithm (6, N)."""
    return torch.stack([distance**k for k in range(5)] + [amplitude.log()])


def measured(
    frame: Frame, draw: np.random.Generator, error: Callable[[Image, Image], Image] = base_error
) -> tuple[torch.Tensor, torch.Tensor]:
    """Distance and amplitude (H, W) as a camera gives them that is off besides by an error."""
    amplitude = frame.amplitude * abs(1 + frame.ratio)
    distance = frame.distance + frame.error
    sigma = NOISE * np.sqrt(np.nanmedian(amplitude) / amplitude).clip(0.5, 3)
    distance = distance + error(distance, amplitude) + sigma * draw.normal(size=distance.shape)
    return torch.tensor(distance), torch.tensor(amplitude)


class Calibration(NamedTuple):
    """What the camera's own recordings say."""

    bounces: SecondBounces
    coefficients: torch.Tensor
    ranges: list[tuple[float, float]]  # of distance and amplitude that it saw
    gain: float  # in true gains
    interval: tuple[float, float]

    def without_base_error(self, distance: torch.Tensor, light: torch.Tensor) -> torch.Tensor:
        """Distance (H, W), metres; beyond the ranges what is off at their ends, as a corrector."""
        seen = zip((distance, light), self.ranges, strict=True)
        of = functions(*(values.reshape(-1).clamp(*ends) for values, ends in seen))
        return distance - (self.coefficients @ of).reshape(distance.shape)


def state(gain: float, light: tuple[float, float, float]) -> SecondBouncesState:
    """What the camera knows of its light."""
    return SecondBouncesState(
        frequencies_hz=(FREQUENCY,), gain=gain, light_half_angle_deg=CONE, light_m=light
    )


def calibrate(seed: int, views: int, light: tuple[float, float, float]) -> Calibration:
    """Fit gain and base error to walls."""
    draw = np.random.default_rng(seed)
    bounces = SecondBounces(camera(), state(0.5 / GAIN, light))
    walls = [frame for name in WALLS for frame in rendered(name, seed, views, light[0])]
    lone = rendered("lone_wall", seed, views, light[0])
    seen = [measured(frame, draw) for frame in walls + lone]
    fit = fit_gain(bounces, seen, functions, torch.eye(4).expand(len(seen), 4, 4))
    shown = (torch.stack(each).flatten() for each in zip(*seen[len(walls) :], strict=True))
    true = torch.tensor(np.stack([frame.distance for frame in lone])).flatten()
    there = true.isfinite()  # A ray may slip through, between two triangles.
    radial, strength = (each[there] for each in shown)
    off = (radial - true[there])[:, None]
    coefficients = torch.linalg.lstsq(functions(radial, strength).T, off).solution[:, 0]
    ranges = [(float(each.min()), float(each.max())) for each in (radial, strength)]
    bounces.gain = fit.gain
    low, high = (GAIN * end for end in fit.interval)
    return Calibration(bounces, coefficients, ranges, GAIN * fit.gain, (low, high))


def on_planes(frame: Frame, error: Image, used: Image) -> Image:
    """Errors without what moves the plane of each flat surface, NaN elsewhere (H, W)."""
    result, columns = np.full_like(error, np.nan), rays() * frame.distance[..., None] ** 2
    for number in np.unique(frame.shape[used]):
        own = used & (frame.shape == number)
        if own.sum() > 30:
            fit = np.linalg.lstsq(columns[own], error[own], rcond=None)[0]
            result[own] = error[own] - columns[own] @ fit
    return result


def share(before: Image, after: Image) -> float:
    """Share of the squared error that is removed, percent; NaN where there is none."""
    total = np.nansum(before**2)
    return float(100 * (1 - np.nansum(after**2) / total)) if total > 1e-9 else np.nan


def scored(name: str, seed: int, views: int, known: Calibration, baseline: float) -> str:
    """One line of the table."""
    draw = np.random.default_rng(seed + 1)
    rows: list[tuple[Image, ...]] = []
    for frame in rendered(name, seed, views, baseline):
        distance, light = measured(frame, draw)
        plain = known.without_base_error(distance, light)
        removed = (plain - known.bounces(plain, light)).numpy()
        used = np.isfinite(frame.error) & np.isfinite(removed)
        if name in WALLS:  # On the wall, the largest surface.
            used &= frame.shape == np.bincount(frame.shape[used]).argmax()
        before = np.where(used, frame.error, np.nan)
        after = before - removed
        flat = on_planes(frame, before, used), on_planes(frame, after, used)
        rows.append((before, after, *flat))
    before, after, *flat = (np.stack(images) for images in zip(*rows, strict=True))
    mean: Callable[..., Image] = np.nanmean
    one, each = before - mean(before), before - mean(before, axis=(1, 2), keepdims=True)
    numbers = [1e3 * float(np.sqrt(mean(values**2))) for values in (before, after)]
    shares = [share(before, after), share(*flat), share(before, one), share(before, each)]
    return f"{name:16}" + "".join(f"{value:10.1f}" for value in numbers + shares)


def draw(seed: int, known: Calibration, out: Path) -> None:
    """Draw the points of the middle row of a corner, from above, as measured and as removed."""
    from matplotlib.figure import Figure

    (frame,) = rendered("long_corner", seed, 1)
    distance, light = measured(frame, np.random.default_rng(seed))
    plain = known.without_base_error(distance, light)
    axes = (figure := Figure(figsize=(6, 3.2), layout="constrained")).subplots()
    row, kinds = HEIGHT // 2, {"measured": plain, "removed": known.bounces(plain, light)}
    for (name, image), dot in zip(kinds.items(), ("tab:red", "tab:blue"), strict=True):
        points = image.numpy()[row, :, None] * rays()[row]
        axes.plot(*points[:, [0, 2]].T, ".", color=dot, label=f"second bounces {name}")
    axes.plot(*(frame.distance[row, :, None] * rays()[row])[:, [0, 2]].T, "k", lw=0.8, label="true")
    axes.set(xlabel="to the right, m", ylabel="ahead, m", aspect="equal")
    axes.legend(frameon=False)
    figure.savefig(out)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--views", type=int, default=4)
    parser.add_argument("--baseline", type=float, default=0.0, help="of the light, metres")
    parser.add_argument("--learned", type=int, help="drawn scenes to learn the remainder from")
    parser.add_argument("--figure", type=Path, help="draw a corner into this file instead")
    options = parser.parse_args()
    seed, views, baseline = options.seed, options.views, options.baseline
    torch.set_num_threads(1)
    known = calibrate(seed + OTHER_SEED, views, (baseline, 0.0, 0.0))
    if options.figure is not None:
        draw(seed, known, options.figure)
        return
    low, high = known.interval
    print(f"seed {seed}: gain over the true one {known.gain:.3f} ({low:.3f} to {high:.3f})")
    if options.learned:
        wanted = RemainderOptions(scenes=options.learned, seed=seed)
        at = state(known.bounces.gain, (baseline, 0.0, 0.0))
        network, left = fit_remainder(camera(), at, (NOISE**2, 0.0, 0.0), wanted)
        print("drawn scenes held out, mm:", *(f"{each:.1f}" for each in left))
        print(
            f"{'without it':16}",
            *(scored(n, seed, views, known, baseline) for n in SCENES),
            sep="\n",
        )
        known.bounces.remainder = network.requires_grad_(False)
    titles = ("mm", "left mm", "removed %", "plane %", "scene %", "frame %")
    print(f"{'scene':16}" + "".join(f"{title:>10}" for title in titles), flush=True)
    for name in SCENES:
        print(scored(name, seed, views, known, baseline), flush=True)


if __name__ == "__main__":
    main()
