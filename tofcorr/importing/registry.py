"""The importers: one line per source of images.

The command line makes `tofcorr import NAME` of each line. The module of that name in
`tofcorr.importing` holds a `click.Command` called `command`, and must not import OpenCV or torch
before it is run.
"""

IMPORTERS = {
    "checkerboard": "Depth and infrared images of a board.",
    "frames": "Depth images and robot poses in files; no board.",
    "rosbag": "A ROS 1 or ROS 2 bag: depth, amplitude and tf.",
    "bop": "A scene of BOP or BlenderProc: depth and camera poses.",
    "distances": "Rows of distances of single-pixel sensors.",
}
"""The line of each importer in `tofcorr import --help`, by its name."""
