"""The commands before there is a recording: an example, poses to drive to, imports."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from tofcorr.cli.shared import LazyGroup, config_options, out_option, show
from tofcorr.files import REPLACED_FILE
from tofcorr.importing.command_line import intrinsics_options, number_list, option, take_intrinsics
from tofcorr.importing.registry import IMPORTERS

if TYPE_CHECKING:
    import numpy as np

    from tofcorr.training.advice import PosePlan
    from tofcorr.training.calibration import TrainingOptions

_TRAINING = "training.calibration:TrainingOptions"
_POSE = {"type": number_list(7), "metavar": "X,Y,Z,QX,QY,QZ,QW"}
_PAIR = {"nargs": 2, "type": float}
_DISTANCES = "Distances to the wall at which the camera will be used, metres."
_START = "The tool's pose where the camera looks squarely at the wall; else poses are relative."
_GUESS = "A guess of the camera's pose on the tool; else the tool's axes are the camera's."


@click.command()
@click.argument("name", required=False)
@out_option("Folder of the example, made anew; left out: NAME in this folder.", required=False)
@option("--seed", "Of all random draws.", default=1, type=click.IntRange(min=0))
def example_command(name: str | None, out: Path | None, seed: int) -> None:
    """Write the example called NAME, or list all of them.

    Each is small input of one kind, a few MB made by the sensor simulator, and the command that
    goes on from it. What only a simulator knows, such as the true hand-eye transform, goes to
    truth.yaml.
    """
    from tofcorr.examples.example import EXAMPLES, example

    if name is None:
        width = max(map(len, EXAMPLES))
        click.echo("\n".join(f"{one:<{width}}  {EXAMPLES[one].summary}" for one in EXAMPLES))
        click.echo("\nNext: tofcorr example bag")
        return
    folder = example(name, out, seed)
    click.echo(f"Example written to {folder}\nNext: {EXAMPLES[name].command_for(folder)}")


@click.command()
@config_options(
    _TRAINING, "train", "The model that will be trained", "solver.max_iterations=30", "ea"
)
@intrinsics_options
@option("--size", "Image size, pixels.", nargs=2, type=int, required=True, metavar="W H")
@option("--distance", _DISTANCES, **_PAIR, required=True, metavar="NEAR FAR")
@option("--number", "How many poses.", default=24, type=click.IntRange(1, 200))
@option("--tilt", "Largest tilt, degrees.", "tilt_deg", default=35.0)
@option("--roll", "Largest roll, degrees.", "roll_deg", default=90.0)
@option("--wall", "Size of the free wall, metres; else large.", "wall_size", **_PAIR, metavar="W H")
@option("--checkerboard", "The wall carries a pattern of dark and bright.", is_flag=True)
@option("--start", _START, **_POSE)
@option("--start-distance", "To the wall there, metres; else the middle.", type=float)
@option("--hand-eye", _GUESS, **_POSE)
@out_option("CSV file of poses; an older one is replaced.", REPLACED_FILE)
def poses_command(options: "TrainingOptions", out: Path, **given: Any) -> None:  # noqa: ANN401
    """Write tool poses that determine the hand-eye transform and the model best.

    Drive the robot to where the camera looks squarely at the wall: that is the start pose. The
    poses keep looking at the same point of the wall. They are sorted: the first ones matter most,
    and one that the robot cannot reach may be left out. Expected standard errors are printed; the
    wall's own plane counts as unknown.
    """
    import numpy as np

    from tofcorr.errors import ConfigError
    from tofcorr.files import write_text
    from tofcorr.training.advice import Workspace, plan_poses

    intrinsics = take_intrinsics(given)
    if intrinsics is None:
        raise ConfigError("--calibrate: there is no recording yet; give the camera's intrinsics.")
    start, hand_eye = (_transform(given.pop(key), key) for key in ("start", "hand_eye"))
    camera, (nearest, farthest) = intrinsics.camera(given.pop("size")), given.pop("distance")
    asked = {key: given.pop(key) for key in ("number", "start_distance")}
    space = Workspace(nearest=nearest, farthest=farthest, **given)
    plan = plan_poses(camera, options.model, space, tool_from_camera=hand_eye, **asked)
    write_text(out, _table(plan, np.eye(4) if start is None else start))
    if start is None:
        click.echo("The poses are relative to the start pose.", err=True)
    show(plan, out)


def _transform(values: tuple[float, ...] | None, key: str) -> "np.ndarray | None":
    """Return the transform (4, 4) of x y z qx qy qz qw."""
    if values is None:
        return None
    import numpy as np

    from tofcorr.data.table import rigid_transforms

    row = np.array([values])
    return rigid_transforms(row[:, :3], row[:, 3:], lambda _: f"--{key.replace('_', '-')}")[0]


def _table(plan: "PosePlan", start: "np.ndarray") -> str:
    """Return the poses as CSV: world_from_tool, metres and quaternion, and what the camera sees."""
    from scipy.spatial.transform import Rotation

    lines = ["tx,ty,tz,qx,qy,qz,qw,distance_m,tilt_deg,roll_deg"]
    for pose, described in zip(start @ plan.start_from_tool.numpy(), plan.described, strict=True):
        quaternion = Rotation.from_matrix(pose[:3, :3]).as_quat(canonical=True)
        numbers = [f"{value:.7f}" for value in (*pose[:3, 3], *quaternion)]
        lines.append(",".join([*numbers, *(f"{value:.3f}" for value in described.tolist())]))
    return "\n".join(lines) + "\n"


@click.group(
    cls=LazyGroup,
    lazy={name: (f"importing.{name}:command", summary) for name, summary in IMPORTERS.items()},
    context_settings={"help_option_names": ["-h", "--help"]},
)
def import_command() -> None:
    """Turn recorded images into a recording."""
