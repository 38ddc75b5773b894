"""Every damage that is refused, by what the reader must say of it."""

import csv
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import yaml

Damage = Callable[[Path], object]
"""Damages the recording in a folder."""
Rows = list[dict[str, str]]

GONE = object()
"""In place of a value: the key is not there."""


def put(values: Any, key: str, value: object) -> None:
    """Set an entry of nested lists and mappings, or change it; dots lead into entries."""
    *parents, last = [int(part) if part.isdigit() else part for part in key.split(".")]
    for part in parents:
        values = values[part]
    if value is GONE:
        del values[last]
    else:
        values[last] = value(values[last]) if callable(value) else value


def header(*changes: tuple[str, object]) -> Damage:
    def damage(folder: Path) -> None:
        path = folder / "recording.yaml"
        values = yaml.safe_load(path.read_text())
        for key, value in changes:
            put(values, key, value)
        path.write_text(yaml.safe_dump(values))

    return damage


def content(name: str, given: str | bytes) -> Damage:
    data = given.encode() if isinstance(given, str) else given
    return lambda folder: (folder / name).write_bytes(data)


def table(edit: Callable[[str], str]) -> Damage:
    """Change the text of frames.csv."""

    def damage(folder: Path) -> None:
        path = folder / "frames.csv"
        path.write_text(edit(path.read_text()))

    return damage


def rows(edit: Callable[[Rows], Rows]) -> Damage:
    """Change the rows of frames.csv."""

    def damage(folder: Path) -> None:
        with (folder / "frames.csv").open(newline="") as file:
            changed = edit(list(csv.DictReader(file)))
        with (folder / "frames.csv").open("w", newline="") as file:
            writer = csv.DictWriter(file, list(changed[0]))
            writer.writeheader()
            writer.writerows(changed)

    return damage


def cells(frame: int, **values: str) -> Damage:
    return rows(lambda all_: [row | values if k == frame else row for k, row in enumerate(all_)])


def without_column(name: str) -> Damage:
    return rows(lambda all_: [{key: row[key] for key in row if key != name} for row in all_])


def array(name: str, edit: Callable[[np.ndarray], np.ndarray]) -> Damage:
    return lambda folder: np.save(folder / f"{name}.npy", edit(np.load(folder / f"{name}.npy")))


def value(name: str, index: tuple[int, ...], new: float) -> Damage:
    def edit(values: np.ndarray) -> np.ndarray:
        values[index] = new
        return values

    return array(name, edit)


def removed(name: str) -> Damage:
    return lambda folder: (folder / name).unlink()


def truncated(name: str) -> Damage:
    return lambda folder: (folder / name).write_bytes((folder / name).read_bytes()[:-1])


IDENTITY = np.eye(4)
MIRROR = np.diag([1.0, 1.0, -1.0, 1.0])
SHEAR = IDENTITY + 0.01 * np.eye(4, k=1) * [[1], [1], [0], [0]]
INFINITE = np.where(IDENTITY == 1, np.inf, 0)
MISSPELT = (("saturation_amplitude", GONE), ("saturation_amplitde", 3))
LARGE = (("camera.width", 100_000), ("camera.height", 100_000))
MISSING: dict[str, Damage] = {
    r"recording\.yaml: there is no such file": removed("recording.yaml"),
    r"frames\.csv: there is no such file": removed("frames.csv"),
    r"depth\.npy: there is no such file": removed("depth.npy"),
}
HEADERS: dict[str, Damage] = {
    r"'saturation_amplitde' is not a known key\. Did you mean 'saturation_am": header(*MISSPELT),
    r"recording\.yaml: 'format': .*got 'rosbag'": header(("format", "rosbag")),
    r"'format' is missing\.": header(("format", GONE)),
    r"'version': .*got 2": header(("version", 2)),
    r"'version': .*got True": header(("version", True)),
    r"'camera\.width' is missing": header(("camera.width", GONE)),
    r"'depth_kind': .*'radial' or 'z'": header(("depth_kind", "depth")),
    r"'camera\.K': K must be upper triangular": header(("camera.K.1.0", 0.1)),
    r"last row of 0 0 1": header(("camera.K.2.2", 2.0)),
    r"'camera\.K\.0\.0': .*finite": header(("camera.K.0.0", float("nan"))),
    r"'camera\.K\.2'.* missing": header(("camera.K.2", GONE)),
    r"'camera\.K': the focal lengths of K must be 0\.001 to 1e\+09": header(("camera.K.0.0", 1e11)),
    r"'camera\.distortion': .* got 3": header(("camera.distortion", [0.1, 0.2, 0.3])),
    r"'camera\.distortion\.0': .*less than or equal": header(("camera.distortion.0", 1e300)),
    r"'camera\.width': .*greater than 0": header(("camera.width", 0)),
    r"'camera': an image of 100000 x 100000 pixels is larger": header(*LARGE),
    r"recording\.yaml: 'camera\.width'": header(("camera.width", 7.5)),
    r"'camera\.height': .*not true or false": header(("camera.height", True)),
    r"'camera\.width'": header(("camera.width", 10**400)),
    r"'modulation_frequency_hz'": header(("modulation_frequency_hz", 0)),
    r"'tool_from_camera': .*reflection": header(("tool_from_camera", MIRROR.tolist())),
    r"'tool_from_camera': .*orthonormal": header(("tool_from_camera", SHEAR.tolist())),
    r"last row .* 0 0 0 1": header(("tool_from_camera.3.3", 2.0)),
    r"finite": header(("tool_from_camera", INFINITE.tolist())),
    r"recording\.yaml: 'planes': .*'recorded' or 'estim.*'guessed'": header(("planes", "guessed")),
    r"recording\.yaml: 'frames\.wrist' is not a known": header(("frames", {"wrist": "tool0"})),
    r"recording\.yaml: 'frames\.tool'": header(("frames", {"tool": ""})),
    r"recording\.yaml: 'frames\.world'": header(("frames", {"world": " tool0"})),
    r"recording\.yaml: 'frames\.camera'": header(("frames", {"camera": "two\nlines"})),
    r"recording\.yaml: 'frames'": header(("frames", ["base", "tool0"])),
}
TEXTS: dict[str, Damage] = {
    r"recording\.yaml: not valid YAML": content("recording.yaml", "camera: [1, 2"),
    r"expected keys and values": content("recording.yaml", "- 1\n- 2\n"),
    r"cannot be read as text": content("recording.yaml", b"\xff\xfe\x00\x81"),
    r"larger than 16 MB": content("recording.yaml", "#" * 16_000_001),
    r"frames\.csv: is empty": content("frames.csv", ""),
    r"separated by ';'": content("frames.csv", "frame;tx\n0;1\n"),
    r"cannot be read as CSV": content("frames.csv", b"\xff\xfe\x00\x81"),
    r"mask\.npy: not a readable \.npy file": content("mask.npy", ""),
}
TABLES: dict[str, Damage] = {
    r"frame 5: 18 of 19 cells": table(lambda t: t.rstrip().rsplit(",", 1)[0]),
    r"frames\.csv: a recording of no frame": table(lambda text: text.splitlines()[0] + "\n"),
    r"column 'tx' appears twice": table(lambda text: text.replace("ambient", "tx", 1)),
    r"frames\.csv: column 'qw' is missing": without_column("qw"),
    r"frame 2, column 'frame': expected 2 \(counting up from zero\), got '3'": rows(
        lambda all_: all_[:2] + all_[3:]
    ),
    r"frame 0, column 'frame': expected 0": rows(
        lambda all_: [row | {"frame": str(k)} for k, row in enumerate(all_, 1)]
    ),
    r"depth\.npy: has 6 frames; frames\.csv has 4 rows": rows(lambda all_: all_[:4]),
}
CELLS: dict[str, Damage] = {
    r"frame 4, column 'qx': expected a finite number": cells(4, qx="nan"),
    r"frame 3, column 'ty': .*number of metres, .*got 'left'": cells(3, ty="left"),
    r"frame 3, column 'ty': .*got '1_0'": cells(3, ty="1_0"),
    r"frame 1, column 'tz': .*got an empty cell": cells(1, tz=""),
    r"frame 3, column 'd': expected a finite number": cells(3, d="1e999"),
    r"frame 5: the quaternion .* length 1\.002": cells(5, qx="0", qy="0", qz="0", qw="1.002"),
    r"frame 5: the quaternion .* length 1e\+09": cells(5, qx="1e9"),
    r"frame 0: the normal nx,ny,nz has length 0\.99": cells(0, nx="0", ny="0", nz="0.99"),
    r"frame 1, column 'target': .*name": cells(1, target=" "),
    r"frame 1, column 'integration_time_us': .*positive": cells(1, integration_time_us="-5"),
    r"'body_temperature_c': .*finite": cells(1, body_temperature_c="inf"),
    r"frame 2, column 'tx': .*metres, at most": cells(2, tx="-2e6"),
    r"frame 2, column 'qx': .*at most 1e\+12": cells(2, qx="1e200"),
    r"frame 2, column 'body_temperature_c': .*finite": cells(2, body_temperature_c="1e300"),
}
ARRAYS: dict[str, Damage] = {
    r"depth\.npy: expected float32.*float64": array("depth", lambda a: a.astype(np.float64)),
    r"depth\.npy: .*got .*>f4": array("depth", lambda a: a.astype(">f4")),
    r"amplitude\.npy: expected float32": array("amplitude", lambda a: a.astype(np.int32)),
    r"mask\.npy: expected uint8": array("mask", lambda a: a.astype(bool)),
    r"depth\.npy: .*\(frames, 5, 7\), got \(6, 5, 6\)": array("depth", lambda a: a[:, :, :-1]),
    r"got \(6, 35\)": array("depth", lambda a: a.reshape(6, -1)),
    r"depth\.npy: is in Fortran order": array("depth", np.asfortranarray),
    r"raw\.npy: recording\.yaml needs \(frames, 4, 5, 7\)": array("raw", lambda a: a[:, :3]),
    r"amplitude\.npy: has 5 frames": array("amplitude", lambda a: a[:5]),
    r"mask\.npy: has 12 frames.* 6 rows": array("mask", lambda a: np.concatenate([a, a])),
    r"depth\.npy: not a readable \.npy file": array("depth", lambda a: a.astype(object)),
    r"depth\.npy: not a readable": truncated("depth.npy"),
}
VALUES: dict[str, Damage] = {
    r"depth.*frame 3, row 1, column 2: 3\.4e\+38; .*metres": value("depth", (3, 1, 2), 3.4e38),
    r"amplitude.*frame 4, row 2, column 3: -0\.5; .*1e\+12": value("amplitude", (4, 2, 3), -0.5),
    r"amplitude.*frame 4, row 2, column 3: 3e\+38; expected": value("amplitude", (4, 2, 3), 3e38),
    r"raw.*frame 4, A1, row 2, column 3: -3e\+38; expected": value("raw", (4, 1, 2, 3), -3e38),
    r"mask\.npy: frame 1, row 0, column 6: 255; expected 0 or 1": value("mask", (1, 0, 6), 255),
}
FILES = (MISSING, HEADERS, TEXTS, TABLES, CELLS, ARRAYS)
REFUSALS = {message: damage for sort in (*FILES, VALUES) for message, damage in sort.items()}
OF_EACH_SORT = {message: damage for sort in FILES for message, damage in list(sort.items())[:2]}
"""Two of each sort, but for values in arrays, which few commands look at before they reach them."""
