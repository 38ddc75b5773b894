"""Draw the README's two pictures of a real recording: its error corrected, and its gap closed.

The recording is that of `tofcorr import checkerboard` in docs/how-to/record.md. The simulator is
ideal: where each ray meets the board.
"""

from pathlib import Path
from typing import TYPE_CHECKING

import click
import numpy as np

if TYPE_CHECKING:
    from tofcorr import Recording

SIZE = 5.7, 3.1
"""Of both pictures, inches: the same, as they stand side by side."""


@click.command()
@click.option("--config", required=True, help="Of the training.")
@click.option("--recording", required=True, type=click.Path(path_type=Path))
@click.option("--out", required=True, type=click.Path(path_type=Path, file_okay=False))
def command(config: str, recording: Path, out: Path) -> None:
    """Write to OUT how training on half of RECORDING corrects the rest, and how its gap closes."""
    import tofcorr
    from tofcorr.pages.drawing import save_figure

    _draw_correction(config, recording, out / "correction.png")
    found = tofcorr.diagnose(recording, _ideal, {"page": False, "simulate_anew": False})
    click.echo(found.verdict)
    figure = found.plot("stages")
    figure.set_size_inches(*SIZE)
    save_figure(figure, out / "gap.png")


def _draw_correction(config: str, recording: Path, out: Path) -> None:
    """Train on half of the poses, and draw the errors of the other half."""
    from matplotlib.figure import Figure

    import tofcorr
    from tofcorr.pages.drawing import BLUE, RED, save_figure
    from tofcorr.pixels.sample import PixelSample
    from tofcorr.training.figures import draw_profile

    found = tofcorr.train(recording, config).calibration
    stages = {name: found.stages[name] for name in ("before", "after")}
    sample = PixelSample(found.data, stages, found.test)
    figure = Figure(figsize=SIZE, layout="constrained")
    panels = figure.subplots(1, 2, sharey=True)
    for axes, name in zip(panels, ("distance", "amplitude"), strict=True):
        covariate = sample.covariate_named(name)
        x = sample.covariates[covariate]
        ends = float(np.nanmin(x)), float(np.nanmax(x))
        for stage, colour in (("before", RED), ("after", BLUE)):
            draw_profile(axes, x, sample.errors_mm[stage], ends, colour, stage)
        axes.axhline(0, color="0.4", linewidth=0.8)
        axes.set_xlabel(covariate)
        axes.grid(alpha=0.25)
    panels[0].set_ylabel("error along the ray, mm")
    panels[0].legend()
    figure.suptitle(f"{len(found.test)} held-out views: mean error, one standard deviation")
    save_figure(figure, out)


def _ideal(recording: "Recording") -> np.ndarray:
    """Return the depth at which each ray meets its board, shape (N, H, W), metres, of its kind."""
    from tofcorr.geometry.rays import ray_directions

    rays = ray_directions(recording.camera).numpy()
    poses = recording.frames.world_from_tool @ recording.tool_from_camera
    planes = zip(poses, recording.frames.normal_world, recording.frames.offset, strict=True)
    depth = [-(n @ pose[:3, 3] + d) / (rays @ pose[:3, :3].T @ n) for pose, n, d in planes]
    along = rays[..., 2] if recording.depth_kind == "z" else 1.0
    return (np.array(depth) * along).astype(np.float32)


if __name__ == "__main__":
    command()
