"""The commands that calibrate a camera: propose poses, inspect, train, compare, check."""

import csv
import io
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from tofcorr.cli.shared import config_options, force_option, out_option, recordings_option
from tofcorr.files import NewPath, ReplacedFile
from tofcorr.importing.command_line import NumberList, intrinsics_options, take_intrinsics

if TYPE_CHECKING:
    import numpy as np

    from tofcorr.comparison.options import EvaluationOptions, SelectionOptions
    from tofcorr.training.advice import PosePlan
    from tofcorr.training.options import TrainingOptions

_TRAINING = "training.options:TrainingOptions"
_EVALUATION = "comparison.options:EvaluationOptions"
_SELECTION = "comparison.options:SelectionOptions"
_POSE = {"type": NumberList(7), "metavar": "X,Y,Z,QX,QY,QZ,QW"}


@click.command()
@config_options(
    _TRAINING, "train", "The model that will be trained", "solver.max_iterations=30", "ea"
)
@intrinsics_options
@click.option("--size", nargs=2, type=int, required=True, metavar="W H", help="Image size, pixels.")
@click.option(
    "--distance",
    nargs=2,
    type=float,
    required=True,
    metavar="NEAR FAR",
    help="Distances to the wall at which the camera will be used, metres.",
)
@click.option("--number", default=24, show_default=True, type=click.IntRange(1, 200))
@click.option("--tilt", "tilt_deg", default=35.0, show_default=True, help="Largest tilt, degrees.")
@click.option("--roll", "roll_deg", default=90.0, show_default=True, help="Largest roll, degrees.")
@click.option(
    *("--wall", "wall_size"),
    nargs=2,
    type=float,
    metavar="W H",
    help="Size of the free wall, metres; else large.",
)
@click.option("--checkerboard", is_flag=True, help="The wall carries a pattern of dark and bright.")
@click.option(
    "--start",
    **_POSE,
    help="The tool's pose where the camera looks squarely at the wall; else poses are relative.",
)
@click.option("--start-distance", type=float, help="To the wall there, metres; else the middle.")
@click.option(
    "--hand-eye",
    **_POSE,
    help="A guess of the camera's pose on the tool; else the tool's axes are the camera's.",
)
@out_option("CSV file of poses; an older one is replaced.", ReplacedFile())
def poses_command(options: "TrainingOptions", out: Path, **given: Any) -> None:  # noqa: ANN401
    """Write tool poses that determine the hand-eye transform and the model best.

    Drive the robot to where the camera looks squarely at the wall: that is the start pose. The
    poses keep looking at the same point of the wall. They are sorted: the first ones matter most,
    and one that the robot cannot reach may be left out. Expected standard errors are printed; the
    wall's own plane counts as unknown.
    """
    import numpy as np

    from tofcorr.errors import ConfigError
    from tofcorr.files import staged_file
    from tofcorr.training.advice import Workspace, plan_poses

    intrinsics = take_intrinsics(given)
    if intrinsics is None:
        raise ConfigError("--calibrate: there is no recording yet; give the camera's intrinsics.")
    start, hand_eye = (_transform(given.pop(key), key) for key in ("start", "hand_eye"))
    camera, (nearest, farthest) = intrinsics.camera(given.pop("size")), given.pop("distance")
    asked = {key: given.pop(key) for key in ("number", "start_distance")}
    space = Workspace(nearest=nearest, farthest=farthest, **given)
    plan = plan_poses(camera, options.model, space, tool_from_camera=hand_eye, **asked)
    with staged_file(out) as part:
        part.write_text(_table(plan, np.eye(4) if start is None else start), encoding="utf-8")
    click.echo(repr(plan))
    relative = " relative to the start pose" if start is None else ""
    click.echo(f"{len(plan.expected)} poses{relative} written to {out}")


def _transform(values: tuple[float, ...] | None, key: str) -> "np.ndarray | None":
    """Return the transform (4, 4) of x y z qx qy qz qw."""
    if values is None:
        return None
    import numpy as np
    from scipy.spatial.transform import Rotation

    from tofcorr.errors import ConfigError

    if abs(float(np.linalg.norm(values[3:])) - 1) > 1e-3:
        named = f"--{key.replace('_', '-')}"
        raise ConfigError(f"{named}: the last four numbers are no unit quaternion x y z w.")
    transform = np.eye(4)
    transform[:3, :3] = Rotation.from_quat(values[3:]).as_matrix()
    transform[:3, 3] = values[:3]
    return transform


def _table(plan: "PosePlan", start: "np.ndarray") -> str:
    """Return the poses as CSV: world_from_tool, metres and quaternion, and what the camera sees."""
    from scipy.spatial.transform import Rotation

    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    columns = ("tx", "ty", "tz", "qx", "qy", "qz", "qw", "distance_m", "tilt_deg", "roll_deg")
    writer.writerow(columns)
    for pose, described in zip(start @ plan.start_from_tool.numpy(), plan.described, strict=True):
        quaternion = Rotation.from_matrix(pose[:3, :3]).as_quat(canonical=True)
        numbers = [f"{value:.7f}" for value in (*pose[:3, 3], *quaternion)]
        writer.writerow([*numbers, *(f"{value:.3f}" for value in described.tolist())])
    return text.getvalue()


@click.command()
@click.argument("recordings", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option("--out", type=NewPath(), help="HTML page with pictures to write.")
@click.option(
    "--planes",
    type=click.Choice(["auto", "known", "unknown"]),
    default="auto",
    show_default=True,
    help="Whether the recorded planes were measured (known) or are a start for the fit (unknown); "
    "auto: as recording.yaml says.",
)
def inspect_command(recordings: tuple[Path, ...], out: Path | None, planes: Any) -> None:  # noqa: ANN401
    """Look at recordings as an experienced user would, and say what is odd, with numbers.

    Units, kind of depth, poses, planes, images and amplitudes are compared on a few pixels of each
    frame. A finding is `impossible` (any fit would be meaningless: every command stops there
    unless --force), `doubtful` (it heads their reports) or a `note`. The exit code is 0 in each
    case.
    """
    from tofcorr.plausibility.examine import inspect

    click.echo(repr(inspect(recordings, planes=planes, out=out)))
    if out is not None:
        click.echo(f"Page written to {out}")


@click.command()
@config_options(_TRAINING, "train", "The model and the training", "solver.max_iterations=30", "ea")
@recordings_option("Folder of a recording; may be given several times for one camera.")
@out_option("Folder of the run, made anew.")
@click.option(
    "--resume",
    type=click.Path(path_type=Path),
    help="Folder of an interrupted run; the fit goes on where it stood.",
)
@force_option
@click.option("--no-figures", is_flag=True, help="Draw no figures for TensorBoard.")
def train_command(
    options: "TrainingOptions",
    recordings: tuple[Path, ...],
    *,
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
    result = train(recordings, options, **given)
    click.echo(repr(result))
    click.echo(f"{result.report['message']} Run filed in {given['out']}")


@click.command()
@config_options(_EVALUATION, "evaluate", "The models and how they are compared", "seed=1", "paper")
@recordings_option("A set of images: one row of the tables; may be given several times.")
@out_option("Folder of the report; must be new.")
@click.option("--device", default=None, help="Where to compute; overrides the configuration.")
@force_option
def evaluate_command(
    options: "EvaluationOptions",
    recordings: tuple[Path, ...],
    device: str | None,
    **given: Any,  # noqa: ANN401
) -> None:
    """Compare models on held-out images, in the paper's two tables.

    Every RECORDING is evaluated on its own, as one set: a random half held out, k-fold
    cross-validation by image with paired t-tests, and repeated random splits if asked for. The
    columns "before" (no calibration) and "hand-eye only" (no depth correction) are there to compare
    with. Writes evaluation.json, evaluation.md, comparison.png and TensorBoard files to OUT.
    """
    from tofcorr.comparison.evaluate import evaluate

    if device:
        options = options.model_copy(update={"device": device})
    click.echo(repr(evaluate(recordings, options, **given)))
    click.echo(f"\nWritten to {given['out']}.")


@click.command()
@config_options(_SELECTION, "select", "The models and what is held out", "folds=5", "paper")
@recordings_option("Folder of a recording; several of one camera are taken together.")
@out_option("New folder.")
@force_option
def select_command(
    options: "SelectionOptions",
    recordings: tuple[Path, ...],
    **given: Any,  # noqa: ANN401
) -> None:
    """Compare models on images, distances and targets that they were not fitted to.

    Names the simplest model within one standard error of the best, and those that do not differ
    significantly from it. Writes selection.json and selection.md to OUT.
    """
    from tofcorr.comparison.select import select

    click.echo(repr(select(recordings, options, **given)))
    click.echo(f"Written to {given['out']}.")


@click.command()
@click.option(
    "--run", required=True, type=click.Path(path_type=Path), help="Folder of the training's run."
)
@recordings_option("A few frames of any wall.")
@click.option(
    "--wall",
    type=click.Choice(["per_image", "one", "recorded"]),
    default="per_image",
    show_default=True,
    help="What is known of the wall: nothing; that all frames show the same one and the robot's "
    "poses are right; or its recorded plane.",
)
@click.option(
    "--threshold-mm",
    type=float,
    default=5.0,
    show_default=True,
    help="Offset or departure from a plane above which the camera counts as drifted.",
)
@click.option("--out", type=ReplacedFile(), help="JSON file to write.")
@force_option
def check_command(run: Path, recordings: tuple[Path, ...], **given: Any) -> None:  # noqa: ANN401
    """Measure a calibration again on a few frames and say how far the camera has drifted.

    The answer is `holds`, `drifted` or `undecided`; the exit code is 0 in each case.
    """
    from tofcorr.drift.check import check

    click.echo(repr(check(run, recordings, **given)))
