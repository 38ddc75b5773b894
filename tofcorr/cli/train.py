"""`tofcorr train`: calibrate recordings and file the run."""

from pathlib import Path

import click

from tofcorr.cli.config_option import config_options


@click.command(name="train", short_help="Calibrate a recording.")
@config_options("train", "The model and the training", default="ea")
@click.option(
    "--recording",
    "recordings",
    required=True,
    multiple=True,
    type=click.Path(path_type=Path),
    help="Folder of a recording; may be given several times for one camera.",
)
@click.option(
    "--out", required=True, type=click.Path(path_type=Path), help="Folder of the run, made anew."
)
@click.option(
    "--resume",
    type=click.Path(path_type=Path),
    help="Folder of an interrupted run to go on from.",
)
def command(
    config: str,
    changes: tuple[str, ...],
    recordings: tuple[Path, ...],
    out: Path,
    resume: Path | None,
) -> None:
    """Fit the error model and the hand-eye transform to recorded frames.

    Half of the poses are held out (see the configuration); the errors on them are what the run
    promises. Ctrl-C ends the fit early and files it as interrupted; --resume goes on from there.
    """
    from tofcorr.data.recording import Recording
    from tofcorr.options import resolve_options
    from tofcorr.pixels.dataset import Dataset
    from tofcorr.training.options import TrainingOptions
    from tofcorr.training.run import resumed_parameters, train

    options = resolve_options(TrainingOptions, config, changes)
    dataset = Dataset(tuple(Recording.open(path) for path in recordings))
    start = None if resume is None else resumed_parameters(resume, options)
    report = train(dataset, options, out, resumed=start)
    click.echo(_table(report))
    click.echo(_advice(report), nl=False)
    for warning in report["warnings"]:
        click.echo(f"Warning: {warning}")
    click.echo(f"{report['message']} Run filed in {out}")


def _table(report: dict) -> str:
    """Return the errors as aligned text."""
    lines = [f"{report['model']:<16}{'train':>18}{'held out':>20}"]
    lines += [f"{'mm':<16}{'mean abs':>9}{'RMS':>9}{'mean abs':>11}{'RMS':>9}"]
    for stage, halves in report["error_mm"].items():
        cells = [halves[half][kind] for half in ("train", "test") for kind in ("mean_abs", "rms")]
        text = ["-" if cell is None else f"{cell:.2f}" for cell in cells]
        name = stage.replace("_", " ")
        lines.append(f"{name:<16}{text[0]:>9}{text[1]:>9}{text[2]:>11}{text[3]:>9}")
    hand_eye = report["hand_eye"]
    if hand_eye["estimated"]:
        translation = [1e3 * row[3] for row in hand_eye["tool_from_camera"][:3]]
        pairs = zip(translation, hand_eye["translation_se_mm"], strict=True)
        lines.append(
            "hand-eye translation, mm: " + "  ".join(f"{t:.2f} ± {s:.2f}" for t, s in pairs)
        )
    return "\n".join(lines)


def _advice(report: dict) -> str:
    """Return which poses to add, a line each; nothing if there is no advice."""
    advice = report["advice"]
    if advice is None:
        return ""
    lines = [
        f"The worst direction is {report['observability']['weakest'][0]['direction']}, known to "
        f"{advice['worst_sigma_mm_or_mrad']:.2f} mm (or mrad). To improve it, add:"
    ]
    lines += [
        f"  {pose['target']:<14}{pose['distance_m']:6.2f} m, tilted {pose['tilt_deg']:.0f} deg, "
        f"rolled by {pose['roll_by_deg']:+.0f}: then {pose['worst_sigma_mm_or_mrad']:.2f}"
        for pose in advice["poses"]
    ]
    return "\n".join([*lines, ""])
