"""Draw the README's picture: held-out error of a real recording before and after correction."""

from pathlib import Path

import click


@click.command()
@click.option("--config", required=True, type=click.Path(path_type=Path))
@click.option("--recording", required=True, type=click.Path(path_type=Path))
@click.option("--out", required=True, type=click.Path(path_type=Path))
def command(config: Path, recording: Path, out: Path) -> None:
    """Train on half of the poses of RECORDING, and draw the errors of the other half to OUT."""
    from matplotlib.figure import Figure

    from tofcorr.data.recording import Recording
    from tofcorr.fit.fitting import fit
    from tofcorr.options import load_options
    from tofcorr.pixels.dataset import Dataset
    from tofcorr.pixels.domain import covered_domain
    from tofcorr.pixels.pixel_sample import sample_pixels
    from tofcorr.pixels.split import split_frames
    from tofcorr.training.figures import draw_profile, save_figure
    from tofcorr.training.options import TrainingOptions
    from tofcorr.training.run import models_by_stage

    options = load_options(TrainingOptions, config)
    dataset = Dataset((Recording.open(recording),))
    train, test = split_frames(dataset, options.split)
    fitted = fit(dataset, train, options, covered_domain(dataset, train))
    stages = models_by_stage(dataset, fitted)
    sample = sample_pixels(dataset, {name: stages[name] for name in ("before", "after")}, test)
    figure = Figure(figsize=(12, 3.4), layout="constrained")
    panels = figure.subplots(1, 3, sharey=True)
    wanted = ("distance", "column", "amplitude")
    for axes, word in zip(panels, wanted, strict=True):
        covariate = next(name for name in sample.covariates if word in name.lower())
        for stage, colour in (("before", "tab:red"), ("after", "tab:blue")):
            draw_profile(axes, sample.covariates[covariate], sample.errors_mm[stage], colour, stage)
        axes.axhline(0, color="0.4", linewidth=0.8)
        axes.set_xlabel(covariate)
        axes.grid(alpha=0.25)
    panels[0].set_ylabel("error along the ray, mm")
    panels[0].legend()
    figure.suptitle(f"{len(test)} held-out views: mean error and one standard deviation")
    save_figure(figure, out)


if __name__ == "__main__":
    command()
