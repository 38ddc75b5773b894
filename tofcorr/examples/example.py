"""The examples by name, each with the command that goes on from it, and the writing of one."""

import shlex
from importlib import import_module
from pathlib import Path
from typing import NamedTuple

from tofcorr.errors import ConfigError
from tofcorr.files import staged_folder
from tofcorr.options import did_you_mean


class Example(NamedTuple):
    """What a folder will hold, and the command that goes on from it; {out} is the folder."""

    summary: str
    command: str

    def command_for(self, folder: Path) -> str:
        """Return the command, as a shell takes it, for the example in a folder."""
        return self.command.format(out=shlex.quote(str(folder)))


EXAMPLES = {
    "bag": Example(
        "A ROS 2 bag: depth, infrared, camera_info and tf of a robot that stops before a wall.",
        "tofcorr import rosbag {out}/stops --depth /camera/depth/image_raw "
        "--amplitude /camera/infra/image_raw --base-frame base_link --tool-frame tool0 --out wall",
    ),
    "images": Example(
        "16-bit PNG images of the same wall, a file of robot poses, and the intrinsics.",
        "tofcorr import frames {out} --depth 'depth/*.png' --amplitude 'ir/*.png' "
        "--poses {out}/poses.txt --intrinsics {out}/camera.yaml --out wall",
    ),
    "board": Example(
        "16-bit PNG images of a checkerboard, the poses of the robot, and the intrinsics.",
        "tofcorr import checkerboard {out} --depth 'depth/{{view}}.png' "
        "--infrared 'ir/{{view}}.png' --board 5x7 --square-mm 40 "
        "--poses {out}/poses.txt --intrinsics {out}/camera.yaml --out wall",
    ),
    "distances": Example(
        "Distances of a sensor of one ray and of one of 8 x 8 zones, before two walls.",
        "tofcorr import distances {out}/north {out}/east --depth-unit-mm 1 --out walls",
    ),
    "recording": Example(
        "A recording, as every import writes one.",
        "tofcorr train --config ea --recording {out} --out run",
    ),
    "arm": Example(
        "A recording of an arm whose joints have offsets, and the arm's description.",
        "tofcorr rig {out}/wall --urdf {out}/arm.urdf --out cell",
    ),
    "simulator": Example(
        "A recording, and depth of an ideal camera at its poses, as a simulator of yours renders.",
        "tofcorr inspect {out}/recording",
    ),
}
"""By name. `simulated` has a function of each name, which fills the folder."""


def example(name: str, out: Path | str | None = None, seed: int = 1) -> Path:
    """Write small real-looking input of a calibration, drawn by the sensor simulator.

    Args:
        name: One of `EXAMPLES`.
        out: The folder to write; it must not exist yet. None: `name` in the current folder.
        seed: Of all random draws.

    Returns:
        The folder. What only a simulator knows, such as the true hand-eye transform, is in its
        `truth.yaml`.

    Raises:
        ConfigError: There is no such example.
        CalibrationDataError: The folder exists, cannot be written, or a package is missing.
    """
    if name not in EXAMPLES:
        known = f"Known: {', '.join(EXAMPLES)}."
        raise ConfigError(f"no example '{name}'.{did_you_mean(name, EXAMPLES)} {known}")
    target = Path(name if out is None else out)
    with staged_folder(target) as folder:
        getattr(import_module("tofcorr.examples.simulated"), name)(folder, seed)
    return target
