"""How the cost grows: a pass over pixels with frames, pixels and columns, a diagnosis with effects.

Times are those of the processor, not of the clock, of one thread. A slope is that of a straight
line through the logarithms: 1 means that twice as much takes twice the time.

python -m benchmarks.scaling [--repeats 3] [--json FILE] [--figure FILE]
"""

import argparse
import json
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from benchmarks.scene import camera_of, frames_in_memory
from tofcorr.diagnosis.diagnose import diagnose
from tofcorr.error_terms.model import ErrorModel, ErrorModelOptions
from tofcorr.estimation.accumulator import MomentAccumulator
from tofcorr.estimation.design import Design
from tofcorr.geometry.rays import ray_directions
from tofcorr.simulation.effects import CATALOGUE
from tofcorr.simulation.simulator import simulate

# Effects that the recording of the diagnosis can test, in the order in which they are added.
_EFFECTS = [name for name in CATALOGUE if name not in ("motion", "timestamp_offset")]


@dataclass(frozen=True)
class Curve:
    """Processor seconds over a size."""

    what: str
    sizes: list[float]
    seconds: list[float]

    @property
    def slope(self) -> float:
        """Of a straight line through the logarithms."""
        return float(np.polyfit(np.log(self.sizes), np.log(self.seconds), 1)[0])


def quickest(work: Callable[[], object], repeats: int) -> float:
    """Return the processor seconds of the quickest of some runs."""
    spent = []
    for _ in range(repeats):
        start = time.process_time()
        work()
        spent.append(time.process_time() - start)
    return min(spent)


def pass_over(
    height: int, width: int, frames: int, degree: int
) -> tuple[Callable[[], object], int]:
    """Return the pass over the pixels of some frames, and the number of its columns.

    Args:
        height: Of an image.
        width: Of an image.
        frames: How many.
        degree: Of the polynomials of distance, amplitude and pixel.
    """
    camera = camera_of(height, width)
    batch, domain = frames_in_memory(frames, camera, torch.Generator().manual_seed(3))
    terms = [
        {"kind": "distance_polynomial", "degree": degree},
        {"kind": "pixel_polynomial", "degree": degree},
        {"kind": "amplitude_polynomial", "variable": "amplitude", "degree": degree},
    ]
    options = ErrorModelOptions.from_mapping({"terms": terms}, "scaling")
    design = Design(ErrorModel(options, domain), domain, ray_directions(camera))
    accumulator = MomentAccumulator(design)
    return lambda: accumulator(batch), design.num_columns


def pass_curves(repeats: int) -> list[Curve]:
    """Measure the pass over pixels: frames of VGA, sizes of an image, degrees of the model."""
    frames = [2, 4, 8, 16]
    sizes = [(60, 80), (120, 160), (240, 320), (480, 640)]
    by_columns = [pass_over(240, 320, 8, degree) for degree in (1, 2, 3, 5, 8)]
    return [
        Curve(
            "frames of 640 x 480",
            [float(n) for n in frames],
            [quickest(pass_over(480, 640, n, 3)[0], repeats) for n in frames],
        ),
        Curve(
            "pixels an image (16 frames)",
            [float(h * w) for h, w in sizes],
            [quickest(pass_over(h, w, 16, 3)[0], repeats) for h, w in sizes],
        ),
        Curve(
            "columns (8 frames of 320 x 240)",
            [float(count) for _, count in by_columns],
            [quickest(work, repeats) for work, _ in by_columns],
        ),
    ]


def diagnosis_curve(numbers: Sequence[int]) -> Curve:
    """Measure a diagnosis with so many effects of the catalogue, of 40 frames of 64 x 50."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "demo"
        simulate("demo", out=path)
        seconds = []
        for number in numbers:
            options = {"catalogue": _EFFECTS[:number], "page": False}
            seconds.append(quickest(lambda o=options: diagnose(path, None, o), 1))
    return Curve("effects of a diagnosis", [float(n) for n in numbers], seconds)


def draw(curves: Sequence[Curve], path: Path) -> None:
    """Draw every curve, and what it would be if it were proportional."""
    from matplotlib.figure import Figure

    from tofcorr.training.figures import save_figure

    figure = Figure(figsize=(2.8 * len(curves), 2.9))
    figure.subplots_adjust(left=0.07, right=0.99, bottom=0.19, top=0.88, wspace=0.3)
    panels = figure.subplots(1, len(curves))
    for axes, curve in zip(panels, curves, strict=True):
        axes.loglog(curve.sizes, curve.seconds, "o-", color="#2166ac", markersize=4)
        line = curve.seconds[-1] * np.array(curve.sizes) / curve.sizes[-1]
        axes.loglog(curve.sizes, line, ":", color="0.5")
        axes.set_title(f"slope {curve.slope:.2f}", fontsize=10)
        axes.set_xlabel(curve.what, fontsize=9)
        axes.set_xticks(curve.sizes, [f"{size:g}" for size in curve.sizes], fontsize=8)
        axes.minorticks_off()
        axes.tick_params(labelsize=8)
    panels[0].set_ylabel("processor seconds", fontsize=9)
    save_figure(figure, path)


def main() -> None:
    """Run, print, write and draw."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--figure", type=Path)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    curves = [*pass_curves(arguments.repeats), diagnosis_curve((5, 10, len(_EFFECTS)))]
    for curve in curves:
        pairs = zip(curve.sizes, curve.seconds, strict=True)
        points = ", ".join(f"{size:g}: {spent:.3f} s" for size, spent in pairs)
        print(f"{curve.what:<34} slope {curve.slope:5.2f}   {points}")
    if arguments.json:
        found = {one.what: {"slope": one.slope, **vars(one)} for one in curves}
        arguments.json.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    if arguments.figure:
        draw(curves, arguments.figure)


if __name__ == "__main__":
    main()
