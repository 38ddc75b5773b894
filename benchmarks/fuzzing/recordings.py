"""Targets: the files of a recording, and what commands do with one first."""

import csv
import io
import random
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import yaml

from benchmarks.fuzzing.mutations import HOSTILE, change_bytes, change_tree
from benchmarks.fuzzing.target import (
    SilentlyDifferentError,
    Target,
    require_equal,
    require_same_array,
    stated,
)
from benchmarks.tiny import Tiny
from tofcorr.data.recording import Recording
from tofcorr.pixels.dataset import Dataset
from tofcorr.plausibility.examine import examine
from tofcorr.training.options import TrainingOptions
from tofcorr.training.run import train

_ARRAYS = ("depth", "amplitude", "mask", "raw")
# Values that an array may hold, from the usual to the largest that are let through.
_VALUES = (0.0, -1.0, 1e-30, 1e-3, 0.3, 1.0, 5.0, 1e3, 9e5, 1.1e6, 1e12, 3e38, np.nan, np.inf)


def targets(tiny: Tiny) -> list[Target]:
    """Return the targets, on copies of a tiny recording."""
    return [
        Target("recording.yaml", 12, _with_file(tiny.full, "recording.yaml", _yaml, _same_header)),
        Target("frames.csv", 12, _with_file(tiny.full, "frames.csv", _table, _same_table)),
        *(
            Target(f"{name}.npy", 3, _with_file(tiny.full, f"{name}.npy", _npy, _same_array))
            for name in _ARRAYS
        ),
        Target("recording, looked at", 0.8, _values(tiny.recording, _look)),
        Target("recording, trained on", 0.8, _values(tiny.recording, _train)),
    ]


Mutate = Callable[[bytes, random.Random], bytes]


def _with_file(
    source: Path, name: str, mutate: Mutate, compare: Callable[[Recording, str], None]
) -> Callable[[random.Random, Path], object]:
    content = (source / name).read_bytes()

    def attempt(generator: random.Random, folder: Path) -> object:
        path = folder / "full"
        if not path.exists():
            shutil.copytree(source, path)
        (path / name).write_bytes(mutate(content, generator))
        try:
            recording = Recording.open(path)
            compare(recording, name)
        finally:
            (path / name).write_bytes(content)
        return recording

    return attempt


def _yaml(content: bytes, generator: random.Random) -> bytes:
    if generator.random() < 0.6:
        tree = change_tree(yaml.safe_load(content), generator)
        content = yaml.safe_dump(tree, allow_unicode=True).encode("utf-8", "surrogatepass")
        if generator.random() < 0.8:
            return content
    return change_bytes(content, generator)


def _same_header(recording: Recording, name: str) -> None:
    said = stated((recording.path / name).read_bytes())
    if said is None:
        return
    camera = recording.camera
    found = {
        "camera": {
            "width": camera.width,
            "height": camera.height,
            "K": camera.matrix,
            "distortion": camera.distortion,
        },
        "depth_kind": recording.depth_kind,
        "modulation_frequency_hz": recording.modulation_frequency,
        "saturation_amplitude": recording.saturation_amplitude,
        "planes": recording.planes,
    }
    require_equal(found, said, name)
    given = said.get("tool_from_camera")
    if given is not None:  # The nearest rotation is taken, within the format's tolerance.
        off = np.abs(recording.tool_from_camera - np.array(given, dtype=np.float64))
        if off.max() > 2e-3:
            raise SilentlyDifferentError(f"{name}.tool_from_camera: off by {off.max():g}")


def _table(content: bytes, generator: random.Random) -> bytes:
    if generator.random() < 0.4:
        return change_bytes(content, generator)
    rows = [line.split(",") for line in content.decode().splitlines()]
    for _ in range(generator.choice((1, 1, 2, 3))):
        row = generator.randrange(len(rows))
        column = generator.randrange(len(rows[row]))
        kind = generator.randrange(6)
        if kind <= 2:
            rows[row][column] = str(generator.choice(HOSTILE[:-2]))
        elif kind == 3:
            del rows[row][column]
        elif kind == 4:
            rows.insert(row, rows[generator.randrange(len(rows))])
        else:
            rows[row], rows[0] = rows[0], rows[row]
        rows = [line for line in rows if line] or [["frame"]]
    return "\n".join(map(",".join, rows)).encode("utf-8", "surrogatepass")


_COLUMNS = {"tx": (0, 3), "ty": (1, 3), "tz": (2, 3)}


def _same_table(recording: Recording, name: str) -> None:
    text = (recording.path / name).read_bytes().decode("utf-8-sig")
    rows = [row for row in csv.reader(io.StringIO(text, newline="")) if row]
    at = {cell.strip(): place for place, cell in enumerate(rows[0])}
    frames = recording.frames
    found = {
        "timestamp_s": frames.timestamp,
        **{key: frames.world_from_tool[:, i, j] for key, (i, j) in _COLUMNS.items()},
        "d": frames.offset,
    }
    for key, values in found.items():
        cells = np.array([float(row[at[key]]) for row in rows[1:]])
        # The plane's offset is divided by the length of its normal, 1 to within 0.001.
        if not np.allclose(values, cells, rtol=2e-3 if key == "d" else 1e-12, atol=1e-12):
            raise SilentlyDifferentError(f"{name}.{key}: other numbers than the cells")


def _npy(content: bytes, generator: random.Random) -> bytes:
    if generator.random() < 0.5:
        return change_bytes(content, generator, reach=128)
    return change_bytes(content, generator)


def _same_array(recording: Recording, name: str) -> None:
    other = np.load(recording.path / name, allow_pickle=False)
    found = recording.read(name.removesuffix(".npy"), np.arange(recording.num_frames))
    assert found is not None
    require_same_array(found, other, name)


def _values(
    source: Path, use: Callable[[Path, random.Random], object]
) -> Callable[[random.Random, Path], object]:
    """Return an attempt on a recording whose numbers were changed, within its format or beyond."""

    def attempt(generator: random.Random, folder: Path) -> object:
        path = folder / "recording"
        shutil.rmtree(path, ignore_errors=True)
        shutil.copytree(source, path, ignore=shutil.ignore_patterns("truth"))
        parts = ("depth", "depth", "depth", "amplitude", "amplitude", "frames", "header")
        for name in generator.sample(parts, generator.choice((1, 1, 2))):
            if name == "header":
                file = path / "recording.yaml"
                file.write_bytes(_yaml(file.read_bytes(), generator))
            elif name == "frames":
                file = path / "frames.csv"
                file.write_bytes(_table(file.read_bytes(), generator))
            else:
                _change_array(path / f"{name}.npy", generator)
        return use(path, generator)

    return attempt


def _change_array(file: Path, generator: random.Random) -> None:
    values = np.load(file)
    frames = slice(None) if generator.random() < 0.4 else generator.randrange(len(values))
    share = generator.choice((0.01, 0.3, 1.0))
    chosen = np.random.default_rng(generator.getrandbits(32)).uniform(size=values.shape) < share
    part = np.zeros_like(chosen)
    part[frames] = chosen[frames]
    if values.dtype == np.uint8:
        values[part] = generator.choice((0, 0, 0, 1, 2))
    elif generator.random() < 0.6:
        values[part] = generator.choice(_VALUES)
    else:
        with np.errstate(over="ignore"):
            values[part] *= generator.choice((1e-30, 1e-3, 0.5, 2.0, 1e3, 1e9, 1e30, -1.0))
    np.save(file, values)


def _look(path: Path, generator: random.Random) -> object:
    del generator
    return examine(Dataset((Recording.open(path),)), "known")


def _train(path: Path, generator: random.Random) -> object:
    options = TrainingOptions.from_mapping(
        {
            "name": "EA",
            "model": {
                "terms": [
                    {"kind": "distance_polynomial", "degree": 3},
                    {"kind": "pixel_polynomial", "degree": 2},
                    {"kind": "amplitude_polynomial", "variable": "amplitude", "degree": 2},
                ][: generator.randrange(4)]
            },
            "solver": {"kind": "lbfgs", "max_iterations": 20},
            "advice": 0,
            "figures": False,
        },
        "fuzz",
    )
    return train(path, options, force=generator.random() < 0.5)
