"""The commands that calibrate cameras: inspect, train, update, pool, rig, compare, check."""

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from tofcorr.cli.shared import (
    FOLDER,
    config_options,
    force_option,
    option,
    out_option,
    recording_option,
    run_option,
    show,
)
from tofcorr.errors import CalibrationDataError
from tofcorr.files import REPLACED_FILE, NewPath
from tofcorr.importing.rosbag import bag_options, opened

if TYPE_CHECKING:
    from tofcorr.comparison.options import EvaluationOptions, SelectionOptions
    from tofcorr.training.calibration import TrainingOptions

_TRAINING = "training.calibration:TrainingOptions"
_EVALUATION = "comparison.options:EvaluationOptions"
_SELECTION = "comparison.options:SelectionOptions"

_PLANES = "known: the planes were measured; unknown: a start; auto: as recording.yaml says."
_PRIOR = "What other cameras of the type have in common: a file that tofcorr pool wrote."
_NAMED = "A diagnosis: what it names is corrected too, where held-out images are better with it."
_NO_FIGURES = "Write no page, and draw no figures for TensorBoard."
_WALL = "What is known: nothing; all frames show one wall, and poses are right; or its plane."
_LENGTHS = "Standard deviation of lengths of the robot's links: estimate their errors too."
_DRIFTED = "Offset or departure from a plane above which the camera counts as drifted."


@click.command()
@click.argument("recordings", nargs=-1, required=True, type=FOLDER)
@option("--out", "HTML page with pictures to write.", type=NewPath())
@option("--planes", _PLANES, default="auto", type=click.Choice(["auto", "known", "unknown"]))
def inspect_command(recordings: tuple[Path, ...], out: Path | None, planes: Any) -> None:  # noqa: ANN401
    """Look at recordings as an experienced user would, and say what is odd, with numbers.

    Units, kind of depth, poses, planes, images and amplitudes are compared on a few pixels of each
    frame. A finding is `impossible` (any fit would be meaningless: every command stops there
    unless --force), `doubtful` (it heads their reports) or a `note`. The exit code is 0 in each
    case.
    """
    from tofcorr.plausibility.examine import inspect

    show(inspect(recordings, planes=planes, out=out), out)


@click.command()
@config_options(_TRAINING, "train", "The model and the training", "solver.max_iterations=30", "ea")
@recording_option("Folder of a recording; may be given several times.", many=True)
@out_option("Folder of the run, made anew.")
@option("--resume", "An interrupted run; the fit goes on where it stood.", type=FOLDER)
@option("--prior", _PRIOR, type=FOLDER)
@option("--with", _NAMED, "diagnosis", type=FOLDER)
@force_option
@option("--no-figures", _NO_FIGURES, is_flag=True)
def train_command(
    options: "TrainingOptions",
    recordings: tuple[Path, ...],
    *,
    diagnosis: Path | None,
    no_figures: bool,
    **given: Any,  # noqa: ANN401
) -> None:
    """Fit the error model and the hand-eye transform to recorded frames.

    Half of the poses are held out (see the configuration); the errors on them are those to expect
    on new frames. Ctrl-C ends the fit early and files it as interrupted; --resume goes on from
    there.
    """
    from tofcorr.training.run import train

    if no_figures:
        options = options.model_copy(update={"figures": False})
    if diagnosis is None:
        found = train(recordings, options, **given)
    elif given["resume"] or given["prior"]:
        raise click.UsageError("--with begins anew and without a prior: leave out the other one.")
    else:
        from tofcorr.comparison.named import train_with

        found = train_with(diagnosis, recordings, options, out=given["out"], force=given["force"])
    show(found, given["out"])


@click.command()
@run_option
@recording_option("New frames, of any wall; may be given several times.", many=True)
@out_option("Folder of the new run, made anew.")
@option("--prior", _PRIOR, type=FOLDER)
@option("--planes", _PLANES, default="auto", type=click.Choice(["auto", "known", "unknown"]))
@force_option
@option("--no-figures", _NO_FIGURES, is_flag=True)
def update_command(
    run: Path,
    recordings: tuple[Path, ...],
    *,
    no_figures: bool,
    **given: Any,  # noqa: ANN401
) -> None:
    """Carry a calibration on with a few new frames, and say which part of it has changed.

    The old run is the prior. The frames tell which explanation is the most probable: nothing
    changed; the mount was bumped; the camera is warmer or colder; both; or it is another camera of
    the type. The result is a run as `tofcorr train` makes it, of all the new frames.
    """
    from tofcorr.training.update import update

    show(update(run, recordings, figures=not no_figures, **given), given["out"])


@click.command()
@option(
    "--run", "A run of each unit; may be given several times.", "runs", multiple=True, type=FOLDER
)
@option("--out", "File to write, for --prior.", required=True, type=REPLACED_FILE)
def pool_command(runs: tuple[Path, ...], out: Path) -> None:
    """Find what the runs of several cameras of one type have in common.

    Mean and scatter of their coefficients, beyond what each run is uncertain by, are the prior of
    the next camera: tofcorr train --prior then needs fewer poses.
    """
    from tofcorr.training.pool import pool

    show(pool(runs, out=out), out)


@click.command()
@click.argument("recordings", nargs=-1, required=True, type=FOLDER)
@config_options(_TRAINING, "train", "The model and the training", "planes=unknown", "ea")
@option("--urdf", "The robot: estimate offsets of its joints too.", type=FOLDER)
@option("--length-tolerance-mm", _LENGTHS, type=float)
@out_option("Folder with a run for each camera, made anew.")
@force_option
@option("--no-figures", "Write no pages, and draw no figures for TensorBoard.", is_flag=True)
def rig_command(
    options: "TrainingOptions",
    recordings: tuple[Path, ...],
    *,
    no_figures: bool,
    **given: Any,  # noqa: ANN401
) -> None:
    """Fit cameras of one robot or cell together: their errors, poses, and walls that they share.

    A recording belongs to the camera that its `frames` in recording.yaml name; without a name, to
    one called as its folder. OUT holds a run folder for each camera, as `tofcorr train` makes it,
    and rig.yaml with the transforms between the cameras and the walls. Cameras that stand still see
    a target moved by hand; the first one's planes are measured. With --urdf the recordings need
    joint angles; the offsets of the joints are estimated too, and robot.urdf has them. With
    --length-tolerance-mm so are the errors of lengths of links.
    """
    from tofcorr.training.rig import rig

    if no_figures:
        options = options.model_copy(update={"figures": False})
    show(rig(recordings, options, **given), given["out"])


@click.command()
@config_options(_EVALUATION, "evaluate", "The models and how they are compared", "seed=1", "paper")
@recording_option("Images: one row of the tables; may be given several times.", many=True)
@out_option("Folder of the report; must be new.")
@force_option
def evaluate_command(
    options: "EvaluationOptions",
    recordings: tuple[Path, ...],
    **given: Any,  # noqa: ANN401
) -> None:
    """Compare models on held-out images, in the paper's two tables.

    Every RECORDING is evaluated on its own, as one set: a random half held out, k-fold
    cross-validation by image with paired t-tests, and repeated random splits if asked for. The
    columns "before" (no calibration) and "hand-eye only" (no depth correction) are there to compare
    with. Writes report.html, evaluation.json, evaluation.md, comparison.png and TensorBoard files
    to OUT.
    Ctrl-C ends it early: the report then holds the models that were finished.
    """
    from tofcorr.comparison.evaluate import evaluate

    show(evaluate(recordings, options, **given), given["out"])


@click.command()
@config_options(_SELECTION, "select", "The models and what is held out", "folds=5", "paper")
@recording_option("Folder of a recording; several are taken together.", many=True)
@out_option("New folder.")
@force_option
def select_command(options: "SelectionOptions", recordings: tuple[Path, ...], **given: Any) -> None:  # noqa: ANN401
    """Compare models on images, distances and targets that they were not fitted to.

    Names the simplest model within one standard error of the best, and those that do not differ
    significantly from it. Writes report.html, selection.json and selection.md to OUT. Ctrl-C ends
    it early: the report then holds the models that were finished.
    """
    from tofcorr.comparison.select import select

    show(select(recordings, options, **given), given["out"])


@click.command()
@click.argument("runs", nargs=-1, required=True, type=FOLDER)
@option("--out", "HTML page to write.", type=NewPath())
def compare_command(runs: tuple[Path, ...], out: Path | None) -> None:
    """Show runs of one camera side by side: errors, hand-eye transforms, options that differ.

    Two hand-eye transforms differ significantly where chance, by their standard errors, makes as
    large a difference in less than one case of twenty.
    """
    from tofcorr.comparison.runs import compare

    show(compare(runs, out=out), out)


@click.command()
@run_option
@recording_option("A few frames of any wall.", many=True)
@option("--wall", _WALL, default="per_image", type=click.Choice(["per_image", "one", "recorded"]))
@option("--threshold-mm", _DRIFTED, default=5.0)
@option("--out", "JSON file to write.", type=REPLACED_FILE)
@option("--page", "HTML page to write.", type=NewPath())
@force_option
def check_command(run: Path, recordings: tuple[Path, ...], **given: Any) -> None:  # noqa: ANN401
    """Measure a calibration again on a few frames and say how far the camera has drifted.

    The answer is `holds`, `drifted` or `undecided`; the exit code is 0 in each case.
    """
    from tofcorr.drift.check import check

    show(check(run, recordings, **given), given["out"], given["page"])


_TRANSLATION = "Half the 95 % interval of the hand-eye translation that is enough, mm."
_ROTATION = "The same of its rotation, degrees."
_BETWEEN = (
    "Distances to the wall between which the next pose lies, metres; else those of the frames."
)


@click.command()
@click.argument("source", type=FOLDER)
@config_options(_TRAINING, "train", "The model that is fitted", "solver.max_iterations=30", "ea")
@option("--port", "Of the page on this machine; 0: any free one.", default=0)
@option("--wanted-mm", _TRANSLATION, default=0.5)
@option("--wanted-deg", _ROTATION, default=0.05)
@option("--distance", _BETWEEN, nargs=2, type=float, metavar="NEAR FAR")
@option("--live", "New folder that keeps each frame's sums.", "folder", type=NewPath())
@option("--run", "New folder for the calibration, written at the end.", type=NewPath())
@option("--once", "Add the frames that are there, say what is known, and end.", is_flag=True)
@option("--no-browser", "Print the address and open no browser.", is_flag=True)
@option("--depth", "SOURCE is a bag with depth images on this topic.", "depth_topic")
@bag_options
def watch_command(
    options: "TrainingOptions",
    source: Path,
    *,
    port: int,
    run: Path | None,
    once: bool,
    no_browser: bool,
    **given: Any,  # noqa: ANN401
) -> None:
    """Calibrate while a recording grows, and show in the browser what is known.

    SOURCE is a recording whose files grow frame by frame, or that tofcorr is going to write there;
    or the folder of a LiveCalibration that another program adds to, which has its own configuration
    and limits; or, with --depth, a bag. The options after --depth are those of tofcorr import
    rosbag. Ctrl-C ends it, and writes the calibration to --run.
    """
    from tofcorr.live.watch import LivePage, Watched, serve, watch
    from tofcorr.training.advice import Workspace

    more = {key: given.pop(key) for key in ("wanted_mm", "wanted_deg", "folder")}
    if between := given.pop("distance"):
        more["space"] = Workspace(nearest=between[0], farthest=between[1])
    bag = None
    if given["depth_topic"] is not None:
        from tofcorr.importing.rosbag.growing import GrowingBag

        bag = GrowingBag(source, partial(opened, source, given, grows=True))
    page = LivePage(source.name)
    # A port that cannot be had is said before anything is written.
    server = None if once else serve(page, port)
    watched = Watched(source, options, bag, page, **more)
    if server is None:
        watched.poll()
    else:
        address = f"http://127.0.0.1:{server.server_port}/"
        click.echo(f"{address} shows {source}; Ctrl-C ends it.")
        if not no_browser:
            click.launch(address)
        try:
            watch(watched)
        except KeyboardInterrupt:
            server.shutdown()
            server.server_close()
    click.echo("\n".join([page.state["verdict"], *page.said]))
    if watched.live is None:
        raise CalibrationDataError(watched.note)
    if run is not None:
        watched.live.save(run)
        click.echo(f"Written to {run}")
