"""`tofcorr poses`: propose robot poses to record, before any recording exists."""

import csv
import io
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from tofcorr.cli.shared_options import config_options
from tofcorr.files.arguments import ReplacedFile
from tofcorr.importing.command_line import NumberList, intrinsics_options, take_intrinsics

if TYPE_CHECKING:
    import numpy as np

    from tofcorr.training.planned_poses import PosePlan

_POSE = "X,Y,Z,QX,QY,QZ,QW"


@click.command()
@config_options("train", "The model that will be trained", "solver.max_iterations=30", default="ea")
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
@click.option("--tilt", default=35.0, show_default=True, help="Largest tilt, degrees.")
@click.option("--roll", default=90.0, show_default=True, help="Largest roll, degrees.")
@click.option(
    "--wall", nargs=2, type=float, metavar="W H", help="Size of the free wall, metres; else large."
)
@click.option("--checkerboard", is_flag=True, help="The wall carries a pattern of dark and bright.")
@click.option(
    "--start",
    type=NumberList(7),
    metavar=_POSE,
    help="The tool's pose where the camera looks squarely at the wall; else poses are relative.",
)
@click.option("--start-distance", type=float, help="To the wall there, metres; else the middle.")
@click.option(
    "--hand-eye",
    type=NumberList(7),
    metavar=_POSE,
    help="A guess of the camera's pose on the tool; else the tool's axes are the camera's.",
)
@click.option(
    "--out",
    required=True,
    type=ReplacedFile(),
    help="CSV file of poses; an older one is replaced.",
)
def command(config: str, changes: tuple[str, ...], out: Path, **given: Any) -> None:  # noqa: ANN401
    """Write tool poses that determine the hand-eye transform and the model best.

    Drive the robot to where the camera looks squarely at the wall: that is the start pose. The
    poses keep looking at the same point of the wall. They are sorted: the first ones matter most,
    and one that the robot cannot reach may be left out. Expected standard errors are printed; the
    wall's own plane counts as unknown.
    """
    import numpy as np

    from tofcorr.errors import ConfigError
    from tofcorr.files.staged import staged_file
    from tofcorr.options import resolve_options
    from tofcorr.training.options import TrainingOptions
    from tofcorr.training.planned_poses import plan_poses
    from tofcorr.training.workspace import Workspace

    intrinsics = take_intrinsics(given)
    if intrinsics is None:
        raise ConfigError("--calibrate: there is no recording yet; give the camera's intrinsics.")
    start, hand_eye = (_transform(given.pop(key), key) for key in ("start", "hand_eye"))
    (nearest, farthest), number = given.pop("distance"), given.pop("number")
    plan = plan_poses(
        intrinsics.camera(given.pop("size")),
        resolve_options(TrainingOptions, config, changes).model,
        Workspace(
            nearest=nearest,
            farthest=farthest,
            tilt_deg=given.pop("tilt"),
            roll_deg=given.pop("roll"),
            wall_size=given.pop("wall"),
            checkerboard=given.pop("checkerboard"),
        ),
        number=number,
        start_distance=given.pop("start_distance"),
        tool_from_camera=hand_eye,
    )
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
        raise ConfigError(
            f"--{key.replace('_', '-')}: the last four numbers are no unit quaternion x y z w."
        )
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
