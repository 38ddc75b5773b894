"""Point clouds as PLY files, binary, little-endian."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

_TYPES = {"float32": "float", "uint8": "uchar"}


def write_ply(path: Path, columns: Mapping[str, np.ndarray], comments: Sequence[str] = ()) -> None:
    """Write points with properties.

    Args:
        path: The file; an older one is overwritten.
        columns: Each property's values, shape (M,), float32 or uint8; x, y, z come first.
        comments: Lines of the header.
    """
    kinds = [(name, values.dtype.newbyteorder("<")) for name, values in columns.items()]
    points = np.empty(len(next(iter(columns.values()))), dtype=kinds)
    for name, values in columns.items():
        points[name] = values
    header = [
        "ply",
        "format binary_little_endian 1.0",
        *(f"comment {comment}" for comment in comments),
        f"element vertex {len(points)}",
        *(f"property {_TYPES[values.dtype.name]} {name}" for name, values in columns.items()),
        "end_header",
    ]
    with path.open("wb") as file:
        file.write(("\n".join(header) + "\n").encode("ascii"))
        file.write(points.tobytes())
