"""The importers: one line per source of images.

The command line makes `tofcorr import NAME` of each line. The module named in it holds a
`click.Command` called `command`, and must not import OpenCV or torch before it is run.
"""

from typing import NamedTuple


class Importer(NamedTuple):
    """One source of images.

    Attributes:
        name: The sub-command of `tofcorr import`.
        summary: Its line in `tofcorr import --help`.
        module: The module of its command, within `tofcorr.importing`.
    """

    name: str
    summary: str
    module: str


_IMPORTERS = (
    Importer("checkerboard", "Depth and infrared images of a board.", "checkerboard.command"),
    Importer("frames", "Depth images and robot poses in files; no board.", "frames.command"),
    Importer("rosbag", "A ROS 1 or ROS 2 bag: depth, amplitude and tf.", "rosbag.command"),
    Importer("bop", "A scene of BOP or BlenderProc: depth and camera poses.", "bop.command"),
    Importer("distances", "Rows of distances of single-pixel sensors.", "distances.command"),
)

IMPORTERS = {importer.name: importer for importer in _IMPORTERS}
"""Every importer by its name."""
