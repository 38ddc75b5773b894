"""The columns of `frames.csv`."""

from tofcorr.conditions import OPTIONAL_CONDITIONS, condition

FILE_NAME = "frames.csv"
TRANSLATION = ("tx", "ty", "tz")
QUATERNION = ("qx", "qy", "qz", "qw")
NORMAL = ("nx", "ny", "nz")
POSE_AND_PLANE = (*TRANSLATION, *QUATERNION, *NORMAL, "d")
TIMESTAMP = condition("timestamp").column

REQUIRED_COLUMNS = ("frame", TIMESTAMP, *POSE_AND_PLANE, "target")
"""Columns that every recording has, in the order in which they are written."""

COLUMN_OF = {"pose_id": "pose_id", **{each.name: each.column for each in OPTIONAL_CONDITIONS}}
"""Columns that a recording may lack, by the attribute of `FrameTable` that holds them."""
