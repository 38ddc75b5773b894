"""Draw the README's picture: held-out error of a real recording before and after correction."""

from pathlib import Path

import click
import numpy as np


@click.command()
@click.option("--config", required=True, type=click.Path(path_type=Path))
@click.option("--recording", required=True, type=click.Path(path_type=Path))
@click.option("--out", required=True, type=click.Path(path_type=Path))
def command(config: Path, recording: Path, out: Path) -> None:
    """Train on half of the poses of RECORDING, and draw the errors of the other half to OUT."""
    from matplotlib.figure import Figure

    import tofcorr
    from tofcorr.pages.drawing import BLUE, RED, save_figure
    from tofcorr.pixels.sample import PixelSample
    from tofcorr.training.figures import draw_profile

    found = tofcorr.train(recording, config).calibration
    stages = {name: found.stages[name] for name in ("before", "after")}
    sample = PixelSample(found.data, stages, found.test)
    figure = Figure(figsize=(12, 3.4), layout="constrained")
    panels = figure.subplots(1, 3, sharey=True)
    for axes, name in zip(panels, ("distance", "column", "amplitude"), strict=True):
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
    figure.suptitle(f"{len(found.test)} held-out views: mean error and one standard deviation")
    save_figure(figure, out)


if __name__ == "__main__":
    command()
