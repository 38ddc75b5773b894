"""What comes of mutated inputs: of every format that tofcorr reads, and the front of its commands.

    python -m benchmarks.fuzz --count 100000 --seed 1 --out fuzz.json

Each input is a valid file with one to three changes: of bytes, of cells, of keys and values, or of
tensors. Hypothesis draws them (`benchmarks.fuzz_by_branches` has libFuzzer draw for it). An input
must be refused in one sentence, or be read as what it says. Counted as failures are tracebacks,
processes that die, more than 20 s of CPU, more than 4 GB of memory, messages of several lines, and
inputs that are read as something else than they say: another reader is asked, and files with a
digest must give the same output as before.
"""

import contextlib
import copy
import csv
import datetime
import io
import json
import math
import os
import resource
import shutil
import signal
import struct
import tempfile
import traceback
import warnings
import zipfile
import zlib
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import click
import hypothesis
import numpy as np
import torch
import yaml
from hypothesis import strategies as st
from PIL import Image
from scipy.spatial.transform import Rotation
from tqdm import tqdm

import tofcorr
from benchmarks import tiny
from tofcorr.comparison.options import EvaluationOptions, SelectionOptions
from tofcorr.correction.corrector import DepthCorrector
from tofcorr.correction.lookup import read_lut
from tofcorr.correction.metadata import load_corrector
from tofcorr.correction.state import load_calibration
from tofcorr.data.recording import Recording
from tofcorr.diagnosis.options import DiagnosisOptions
from tofcorr.errors import TofcorrError
from tofcorr.importing.bop.scene import read_scene_camera
from tofcorr.importing.distances.readings import read_distances
from tofcorr.importing.images import read_array, read_grey
from tofcorr.importing.intrinsics import read_intrinsics
from tofcorr.importing.pose_files import read_poses
from tofcorr.importing.run import RefusedViewError
from tofcorr.options import Options, load_options, resolve_options, shipped_names
from tofcorr.pixels.dataset import Dataset
from tofcorr.plausibility.examine import examine
from tofcorr.simulation.options import SimulatorOptions
from tofcorr.simulation.simulator import simulate
from tofcorr.training.calibration import TrainingOptions
from tofcorr.training.run import train

SECONDS, MEMORY, LONGEST_MESSAGE = 20.0, 4 * 2**30, 5000
HOSTILE: list[Any] = [  # values that a file may hold anywhere and that a program may not expect
    *(None, True, False, 0, 1, -1, 2, 7, 10**6, 2**31, -(2**63), 10**30, 10**400),
    *(0.0, -0.0, 0.5, 1.5, -1e-3, 1e-9, 1e-320, 1e6, 1e12, 1.1e12, 1e30, 1e200, -1e308),
    *(math.inf, -math.inf, math.nan),
    *("", " ", "nan", "1e999", "1_0", "0x1p4", "null", "\u0663", "a\nb", "\x1b[31m", "x" * 3000),
    *("amplitude", "radial", "z", "auto", "none", "white", "../..", "\ud7ff\U0001f600"),
    *([], {}, [[]], [0], [1.0, 2.0], [None], {"a": 1}, {1: 2}, [[1.0, 0.0], [0.0]], ["a", "b"]),
    *(datetime.date(2026, 11, 22), b"\x00\xff"),
]
TOKENS = [  # bytes that mean something in one of the formats of text
    *(b"\x00", b"\xff\xfe", b"\n", b"\r", b",", b";", b":", b"-", b"#", b'"', b"'", b"[", b"}"),
    *(b"nan", b"inf", b"-inf", b"1e309", b"1e-320", b"0x10", b"1_0", b"9" * 400, b"-0", b"1e30"),
    *(b"!!python/object:os.system ", b"!!bool ", b"&a ", b"*a ", b"<<: ", b"\xe2\x80\xa8"),
    *(b"\t", b"{" * 200, b"[" * 2000, b"%", b"true", b"null", b"~", b"\xef\xbb\xbf", b"\xc3"),
]
FACTORS = (-1, 0, 10, 1000, 1e6, 1e-6, 1e15, -1e300, 1.01, 1e-200, math.inf, math.nan)
FRAMES = (
    torch.linspace(0.3, 3.0, 120).reshape(10, 12),
    torch.linspace(10.0, 5e4, 120).reshape(10, 12).flip(0),
)


class SilentlyDifferentError(Exception):
    """A mutated input was accepted, and means something else than what it says."""


@dataclass(frozen=True)
class Target:
    """One file, and one way to read it.

    Attributes:
        name: Of the file.
        content: A valid one.
        read: Reads a file; raises a `TofcorrError` if the input is refused.
        load: Makes lists, dicts and tensors of it, to be changed; None: bytes alone are changed.
        dump: Writes them again.
        same: Raises if what was read is not what a file says; is told whether bytes were changed.
        share: Of all inputs, relative to the others'.
    """

    name: str
    content: bytes
    read: Callable[[Path], Any]
    load: Callable[[bytes], Any] | None = None
    dump: Callable[[Any], bytes] = bytes
    same: Callable[[Path, Any, bool], None] = lambda path, found, by_bytes: None
    share: float = 3.0


# Changes, as strategies of Hypothesis.


@st.composite
def edited(draw: st.DrawFn, content: bytes) -> bytes:
    """Bytes of which some are flipped, overwritten, inserted, cut out, repeated or cut off."""
    for _ in range(draw(st.integers(1, 3))):
        start = draw(st.integers(0, len(content)))
        end = start + draw(st.sampled_from([1, 4, 32, 256]))
        part, new = content[start:end], draw(st.sampled_from(TOKENS) | st.binary(max_size=64))
        flipped = bytes(part[:1][0] ^ (1 << draw(st.integers(0, 7))) for _ in part[:1])
        middle, rest = draw(
            st.sampled_from(
                [
                    *((flipped, start + 1), (new, start), (new, start + len(new)), (b"", end)),
                    *((part + part, end), (b"", len(content))),
                ]
            )
        )
        content = content[:start] + middle + content[rest:]
    return content


@st.composite
def changed(draw: st.DrawFn, tree: Any) -> Any:  # noqa: ANN401 - any value
    """Keys and values, of which one to three entries are changed."""
    holder = {"": copy.deepcopy(tree)}
    for _ in range(draw(st.integers(1, 3))):
        place, key = draw(st.sampled_from(list(_entries(holder))))
        value, hostile = place[key], copy.deepcopy(draw(st.sampled_from(HOSTILE)))
        kind = draw(st.integers(0, 9))
        if isinstance(value, torch.Tensor) and kind < 6:
            place[key] = draw(_tensor(value))
        elif isinstance(value, bytes) and kind < 6:
            place[key] = draw(edited(value))
        elif isinstance(value, int | float) and not isinstance(value, bool) and kind < 3:
            place[key] = value * draw(st.sampled_from(FACTORS)) if abs(value) < 1e300 else 1.0
        elif kind < 6 or key == "":
            place[key] = hostile
        elif kind == 6:
            del place[key]
        elif kind == 7:
            place[key] = draw(st.sampled_from([[value], [value, value], {"a": value}, str(value)]))
        elif isinstance(place, list):
            place[:] = [*place[: len(place) // 2], hostile, *place] if kind == 8 else place * 3
        else:
            place[draw(st.sampled_from(["unknown", str(key)[:-1], str(key).upper(), 3]))] = hostile
    return holder.get("")


def _entries(tree: Any) -> Iterator[tuple[Any, Any]]:  # noqa: ANN401 - any value
    for key in list(tree) if isinstance(tree, dict) else range(len(tree)):
        yield tree, key
        if isinstance(tree[key], dict | list):
            yield from _entries(tree[key])


def _tensor(values: torch.Tensor) -> st.SearchStrategy[Any]:
    """Values of another shape, size, kind or order, or none."""
    values = values.to_dense()
    cut = values[..., :0] if values.dim() else values.reshape(1)
    order = values.flatten()[torch.randperm(values.numel())].reshape(values.shape)
    shapes = [values[None], torch.cat([values.reshape(-1)] * 2), cut, order, values.tolist()]
    scaled = [values.double() * factor for factor in (*FACTORS, 1e30, 1e-300)]
    kinds = [torch.float32, torch.int64, torch.bool, torch.complex128]
    others = [torch.full_like(values, 77), values.float().to_sparse(), *map(values.to, kinds)]
    return st.sampled_from([*shapes, *scaled, *others])


@st.composite
def mutated(draw: st.DrawFn, target: Target) -> tuple[bytes, bool]:
    """A mutated file of a target, and whether its bytes were changed."""
    if target.load is None or draw(st.booleans()):
        return draw(edited(target.content)), True
    try:
        return target.dump(draw(changed(target.load(target.content)))), False
    except (TypeError, ValueError, OverflowError, AttributeError):  # the format cannot say it
        hypothesis.reject()


def outcome(target: Target, folder: Path, drawn: tuple[bytes, bool]) -> tuple[str, str]:
    """Read one input; say what came of it, and where."""
    content, by_bytes = drawn
    path = folder / target.name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)

    def stop(*_: object) -> None:
        raise TimeoutError

    signal.signal(signal.SIGPROF, stop)
    signal.setitimer(signal.ITIMER_PROF, SECONDS)
    try:
        with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
            warnings.simplefilter("ignore")
            target.same(path, target.read(path), by_bytes)
    except TofcorrError as error:
        whole = "\n" not in str(error) and len(str(error)) <= LONGEST_MESSAGE
        return ("refused", "") if whole else ("not one sentence", str(error)[:300])
    except SilentlyDifferentError as error:
        return "silently different", str(error)[:300]
    except BaseException as error:  # noqa: BLE001 - any traceback is what is looked for
        kinds = {TimeoutError: "slow", MemoryError: "memory"}
        own = [x for x in traceback.extract_tb(error.__traceback__) if "/tofcorr/" in x.filename]
        where = f"{own[-1].filename}:{own[-1].lineno}" if own else "outside"
        return kinds.get(type(error), "traceback"), f"{where} {type(error).__name__}: {error}"[:300]
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
    return "accepted", ""


def run_all(valid: Path, number: int, seed: int, count: int) -> tuple[Counter[str], list[str]]:
    """Fuzz one target in this process; return the outcomes, and what failed how."""
    outcomes: Counter[str] = Counter()
    failures: list[str] = []
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)  # what libraries print
    with tempfile.TemporaryDirectory() as name:
        target = all_targets(valid, seed)[number]
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
        most = pages * resource.getpagesize() + MEMORY
        resource.setrlimit(resource.RLIMIT_AS, (most, resource.RLIM_INFINITY))

        @hypothesis.seed(seed)
        @hypothesis.settings(
            max_examples=count,
            database=None,
            deadline=None,
            phases=[hypothesis.Phase.generate],
            suppress_health_check=list[Any](hypothesis.HealthCheck),
        )
        @hypothesis.given(mutated(target))
        def test(drawn: tuple[bytes, bool]) -> None:
            kind, where = outcome(target, Path(name) / "inputs", drawn)
            outcomes[kind] += 1
            if kind not in ("refused", "accepted"):
                failures.append(f"{target.name}: {kind}: {where}")

        test()
    return outcomes, failures


# What another reader says.


def stated(path: Path) -> Any:  # noqa: ANN401 - YAML may hold anything
    """Return what PyYAML's slow parser reads, or None where it refuses what libyaml allows."""
    try:
        return yaml.safe_load(path.read_bytes())
    except (yaml.YAMLError, ValueError):
        return None


def require_equal(found: Any, said: Any, where: str) -> None:  # noqa: ANN401 - any value
    """Refuse a value that was read and is not what the file states.

    Keys that one of both lacks are not compared: unknown keys of a recording are ignored, and what
    a file leaves out has a default, as null has.
    """
    if isinstance(found, dict) and isinstance(said, dict):
        for key in found.keys() & said.keys():
            require_equal(found[key], said[key], f"{where}.{key}")
    elif isinstance(found, list | tuple) and isinstance(said, list | tuple):
        if len(found) != len(said):
            raise SilentlyDifferentError(f"{where}: {len(said)} entries became {len(found)}")
        for place, (one, other) in enumerate(zip(found, said, strict=True)):
            require_equal(one, other, f"{where}.{place}")
    elif said is not None and found != said and str(found) != str(said):
        with contextlib.suppress(TypeError, ValueError, OverflowError):
            if np.float64(found) == np.float64(said):  # type: ignore[arg-type]
                return
        raise SilentlyDifferentError(f"{where}: {said!r} became {found!r}")


def require_numbers(found: Any, said: Any, where: str, rtol: float = 0.0) -> None:  # noqa: ANN401
    """Refuse numbers that were read and are not those that another reader finds."""
    found, said = np.asarray(found), np.asarray(said)
    if found.shape != said.shape or not np.allclose(found, said, rtol, 1e-12, equal_nan=True):
        raise SilentlyDifferentError(f"{where}: other numbers than another reader finds")


# The formats: how a file becomes lists and dicts, and is written again.


def _to_yaml(tree: Any) -> bytes:  # noqa: ANN401 - any value
    return yaml.safe_dump(tree, allow_unicode=True).encode("utf-8", "surrogatepass")


def _to_json(tree: Any) -> bytes:  # noqa: ANN401 - any value
    return json.dumps(tree, default=str).encode("utf-8", "replace")


def _cells(content: bytes) -> list[list[str]]:
    return [line.split(",") for line in content.decode().splitlines()]


def _to_csv(rows: Any) -> bytes:  # noqa: ANN401 - any value
    lines = [row if isinstance(row, list) else [row] for row in rows or [] if row != []]
    return "\n".join(",".join(map(str, line)) for line in lines).encode("utf-8", "surrogatepass")


def _saved(save: Callable[[Any, Any], Any]) -> Callable[[Any], bytes]:
    def dump(values: Any) -> bytes:  # noqa: ANN401 - any value
        written = io.BytesIO()
        save(values, written)
        return written.getvalue()

    return dump


def _tensors(content: bytes) -> Any:  # noqa: ANN401 - what was saved
    return torch.load(io.BytesIO(content), weights_only=True)


def _lut(content: bytes) -> dict[str, Any]:
    with np.load(io.BytesIO(content)) as file:
        arrays = {name: file[name] for name in file.files}
    meta = json.loads(str(arrays.pop("metadata")))
    return {name: torch.from_numpy(one) for name, one in arrays.items()} | {"metadata": meta}


def _save_lut(values: Any, file: Any) -> None:  # noqa: ANN401 - any value
    held = values if isinstance(values, dict) else {"metadata": values}
    arrays: dict[str, Any] = {}
    for name, one in held.items():
        is_tensor = isinstance(one, torch.Tensor)
        arrays[str(name)] = np.array(one.to_dense() if is_tensor else json.dumps(one, default=str))
    np.savez(file, **arrays)


def _records(content: bytes) -> dict[str, bytes]:
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def _save_records(records: Any, file: Any) -> None:  # noqa: ANN401 - any value
    with zipfile.ZipFile(file, "w") as archive:
        for name, one in records.items() if isinstance(records, dict) else ():
            archive.writestr(str(name) or "x", one if isinstance(one, bytes) else repr(one))


def _chunks(content: bytes) -> dict[str, bytes]:
    """The chunks of a PNG; those of one name together."""
    place, found = 8, dict[str, bytes]()
    while place < len(content):
        (length,) = struct.unpack(">I", content[place : place + 4])
        name = content[place + 4 : place + 8].decode()
        found[name] = found.get(name, b"") + content[place + 8 : place + 8 + length]
        place += 12 + length
    return found


def _to_png(chunks: Any) -> bytes:  # noqa: ANN401 - any value
    """A PNG with checksums that fit."""
    content = b"\x89PNG\r\n\x1a\n"
    for key, data in chunks.items() if isinstance(chunks, dict) else ():
        body = str(key).encode()[:4].ljust(4, b"x") + (data if isinstance(data, bytes) else b"")
        content += struct.pack(">I", len(body) - 4) + body + struct.pack(">I", zlib.crc32(body))
    return content


# The targets, and how they are read.


def _within(folder: Path, use: Callable[[Path], Any]) -> Callable[[Path], Any]:
    def read(path: Path) -> Any:  # noqa: ANN401 - what the use returns
        shutil.copytree(folder, path.with_name("all"), dirs_exist_ok=True)
        shutil.copy(path, path.with_name("all"))
        return use(path.with_name("all"))

    return read


def _header(path: Path, found: Recording, _: bool) -> None:
    camera, said = found.camera, stated(path)
    names = ("depth_kind", "saturation_amplitude", "planes")
    values = {name: getattr(found, name) for name in names}
    values["modulation_frequency_hz"] = found.modulation_frequency
    values["camera"] = {"K": camera.matrix} | {
        name: getattr(camera, name) for name in ("width", "height", "distortion")
    }
    require_equal(values, said, path.name)


def _table(path: Path, found: Recording, _: bool) -> None:
    text, frames = path.read_bytes().decode("utf-8-sig"), found.frames
    rows = [row for row in csv.reader(io.StringIO(text, newline="")) if row]
    at = {cell.strip(): place for place, cell in enumerate(rows[0])}
    places = zip("xyz", frames.world_from_tool[:, :3, 3].T, strict=True)
    read = {"timestamp_s": frames.timestamp, "d": frames.offset}
    for key, values in (read | {f"t{axis}": one for axis, one in places}).items():
        cells = [float(row[at[key]]) for row in rows[1:]]
        # The plane's offset is divided by the length of its normal, 1 to within 0.001.
        require_numbers(values, cells, key, 2e-3 if key == "d" else 1e-12)


def _array(path: Path, found: Recording, _: bool) -> None:
    values = found.read(path.stem, np.arange(found.num_frames))
    require_numbers(values, np.load(path, allow_pickle=False), path.name)


def _looked_at(path: Path) -> object:
    return examine(Dataset((Recording.open(path),)), "known")


def _trained_on(path: Path) -> object:
    return train(path, resolve_options(TrainingOptions, "e0", ("advice=0", "figures=false")))


def all_targets(folder: Path, seed: int) -> list[Target]:
    """Return every target, with the valid files that it mutates in a folder."""
    made = tiny.make(folder, seed)
    return [
        *recordings(made),
        *archives(made),
        *configurations(made),
        *imports(folder, np.random.default_rng(seed)),
    ]


def recordings(made: Path) -> list[Target]:
    """The files of a recording, read with all others, and what commands do with it first."""

    def content(name: str) -> bytes:
        return (made / "full" / name).read_bytes()

    opened = _within(made / "full", Recording.open)
    yaml_, csv_ = (yaml.safe_load, _to_yaml), (_cells, _to_csv)
    arrays = [f"{name}.npy" for name in ("depth", "amplitude", "mask", "raw")]
    whole = {use: _within(made / "recording", use) for use in (_looked_at, _trained_on)}
    depth = (made / "recording" / "depth.npy").read_bytes()
    save = _saved(lambda values, file: np.save(file, np.asarray(values)))

    def scaled(content: bytes) -> Any:  # noqa: ANN401 - a tensor in a list
        return torch.from_numpy(np.load(io.BytesIO(content)))

    return [
        Target("recording.yaml", content("recording.yaml"), opened, *yaml_, _header, 12),
        Target("frames.csv", content("frames.csv"), opened, *csv_, _table, 12),
        *(Target(name, content(name), opened, same=_array) for name in arrays),
        *(Target("depth.npy", depth, use, scaled, save, share=0.8) for use in whole.values()),
    ]


def _called(corrector: Any) -> list[Any]:  # noqa: ANN401 - a module or a scripted one
    with torch.no_grad():
        found = corrector(*FRAMES)
    return list(found) if isinstance(found, tuple) else [found]


def _state(path: Path) -> list[Any]:
    found = load_calibration(path)
    corrector = DepthCorrector.from_state(found)
    corrector.metadata()
    if (found.camera.height, found.camera.width) != (10, 12):
        return [corrector.radial_of_z]
    return [*_called(corrector), found.tool_from_camera]


def _read_lut(path: Path) -> list[Any]:
    table = read_lut(path)
    if table.offset.shape != (10, 12):
        return [np.array(table.offset)]
    return [np.array(one) for one in table(*(one.numpy() for one in FRAMES))]


def archives(made: Path) -> list[Target]:
    """The binary files that tofcorr writes itself: bytes, records, and values saved again."""

    def module(path: Path) -> list[Any]:
        return _called(tofcorr.DepthCorrection.load(path))

    def scripted(path: Path) -> list[Any]:
        return _called(load_corrector(path)[0])

    readers: dict[str, tuple[Callable[[Path], list[Any]], Any, Any]] = {
        "run/state.pt": (_state, _tensors, torch.save),
        "module.pt": (module, _tensors, torch.save),
        "run/corrector.ts": (scripted, None, None),
        "corrector.npz": (_read_lut, _lut, _save_lut),
    }
    found = []
    for name, (read, load, save) in readers.items():
        path = made / name
        wanted, content = read(path), path.read_bytes()

        def same(path: Path, found: list[Any], by_bytes: bool, wanted: Any = wanted) -> None:  # noqa: ANN401
            if by_bytes:  # Saved again by torch it has no seal.
                for one, other in zip(found, wanted, strict=True):
                    require_numbers(one, other, path.name)

        def records(path: Path, found: list[Any], _: bool, same: Any = same) -> None:  # noqa: ANN401
            same(path, found, True)

        found.append(Target(path.name, content, read, _records, _saved(_save_records), records, 8))
        if load is not None:
            found.append(Target(path.name, content, read, load, _saved(save), same, 6))
    return found


def configurations(made: Path) -> list[Target]:
    """Configurations, sensors, and a simulator that runs."""

    def said(path: Path, found: Any, _: bool) -> None:  # noqa: ANN401 - options, or a sensor
        found = found.sensor if isinstance(found, tofcorr.SensorModel) else found
        require_equal(found.to_mapping(), stated(path), path.name)

    def sensed(path: Path) -> tofcorr.SensorModel:
        sensor = tofcorr.SensorModel.load(path)
        with torch.no_grad():
            sensor(*FRAMES, generator=torch.Generator().manual_seed(1))
        return sensor

    def simulated(path: Path) -> object:
        options = load_options(SimulatorOptions, path)
        robot, camera = options.robot, options.camera
        frames = sum(shot.poses for shot in options.shots)
        frames += robot.repeat_poses * robot.repeat_frames
        if frames > 60 or camera.width * camera.height > 1000:  # only read, not run
            return options
        shutil.rmtree(path.with_name("simulated"), ignore_errors=True)
        return simulate(options, path.with_name("simulated"))

    classes: list[type[Options]] = [
        *(TrainingOptions, EvaluationOptions, SelectionOptions, DiagnosisOptions, SimulatorOptions)
    ]

    def by_words(path: Path) -> object:
        words = path.read_text("utf-8", "replace").split("\n")
        return resolve_options(TrainingOptions, "ea", tuple(words))

    yaml_ = (yaml.safe_load, _to_yaml)
    words = b"folds=2\nmodel.terms.0.degree=3\nsolver.kind=lbfgs"
    found = [Target("set.txt", words, by_words, share=4)]
    for cls in classes:
        for name in shipped_names(cls.config_folder)[:4]:
            # All keys with their defaults, so that those that no file names are changed too.
            content = _to_yaml(resolve_options(cls, name).to_mapping())
            file = f"{cls.config_folder}_{name}.yaml"
            found.append(Target(file, content, partial(load_options, cls), *yaml_, said, 2))
    sensor = yaml.safe_load((made / "sensor.yaml").read_text(encoding="utf-8"))
    sensor["camera"] |= {"width": 12, "height": 10}

    return [
        *found,
        Target("sensor.yaml", _to_yaml(sensor), sensed, *yaml_, said, 5),
        Target("simulator.yaml", _to_yaml(tiny.simulator(1)), simulated, *yaml_, share=0.4),
    ]


def imports(folder: Path, rng: np.random.Generator) -> list[Target]:
    """What other programs write, and importers read."""

    def lens(path: Path) -> object:
        found = read_intrinsics(path)
        if np.shape(found.matrix) != (3, 3) or not np.isfinite(found.matrix).all():
            raise SilentlyDifferentError(f"{path.name}: a matrix that is none was accepted")
        return found.camera((512, 424))

    def image(path: Path) -> np.ndarray:
        try:
            return read_grey(path) if path.suffix == ".jpg" else read_array(path)
        except RefusedViewError as error:
            raise TofcorrError(str(error)) from None

    def as_numpy(path: Path, found: np.ndarray, _: bool) -> None:
        require_numbers(found, np.load(path, allow_pickle=False).squeeze(), path.name)

    poses = np.tile(np.eye(4), (6, 1, 1))
    poses[:, :3, :3] = Rotation.from_quat(rng.normal(size=(6, 4))).as_matrix()
    poses[:, :3, 3] = rng.normal(size=(6, 3))
    turns = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    rows = np.column_stack([0.1 * np.arange(6), poses[:, :3, 3], turns])
    head = "timestamp_s,tx,ty,tz,qx,qy,qz,qw\n"
    k, distortion = [[365.5, 0.0, 255.5], [0.0, 366.5, 205.0], [0.0, 0.0, 1.0]], [0.09, -0.27, 0, 0]
    flat = np.ravel(k).tolist()
    opencv = "%YAML:1.0\n---\nimage_width: 512\nimage_height: 424\ncameraMatrix: !!opencv-matrix "
    opencv += f"{{rows: 3, cols: 3, dt: d, data: {flat}}}\n"
    ros: dict[str, Any] = {"image_width": 512, "image_height": 424}
    ros["camera_matrix"] = {"rows": 3, "cols": 3, "data": flat}
    ros["distortion_coefficients"] = {"rows": 1, "cols": 4, "data": distortion}
    ros["distortion_model"] = "plumb_bob"
    readings = [f"{0.5 + n / 100},{n},{n + 1},{n + 2},400" for n in range(8)]
    one = {"cam_K": flat, "depth_scale": 0.1, "cam_t_w2c": [1.0, 2.0, 3.0]}
    one["cam_R_w2c"] = np.eye(3).ravel().tolist()
    depth = rng.integers(400, 4000, (10, 12)).astype(np.uint16)
    found: dict[str, tuple[Callable[[Path], Any], Any]] = {
        "tum.txt": (read_poses, "\n".join(" ".join(map(str, row)) for row in rows.tolist())),
        "poses.csv": (read_poses, head + "\n".join(",".join(map(str, x)) for x in rows.tolist())),
        "poses.npy": (read_poses, _saved(lambda values, file: np.save(file, values))(poses)),
        "samples.yaml": (read_poses, [{"effector_wrt_world": x.ravel().tolist()} for x in poses]),
        "own.yaml": (lens, {"width": 512, "height": 424, "K": k, "distortion": distortion}),
        "numbers.json": (lens, {"width": 512, "height": 424, "camera_matrix": k}),
        "ros.yaml": (lens, ros),
        "opencv.yaml": (lens, opencv),
        "scene_camera.json": (read_scene_camera, {str(n): one for n in range(3)}),
        "measurements.csv": (
            lambda path: read_distances(path, (2, 2), None),
            "\n".join(["time,a,b,c,d", *readings]),
        ),
    }
    dumps = {".yaml": (yaml.safe_load, _to_yaml), ".json": (json.loads, _to_json)}
    dumps[".csv"] = (_cells, _to_csv)
    targets = []
    for name, (read, given) in found.items():
        suffix = Path(name).suffix
        content = given.encode() if isinstance(given, str) else given
        content = content if isinstance(content, bytes) else dumps[suffix][1](content)
        load, dump = dumps.get(suffix, (None, bytes)) if name != "opencv.yaml" else (None, bytes)
        targets.append(Target(name, content, read, load, dump))
    grey = np.dstack([(depth // 16).astype(np.uint8)] * 3)
    pictures = {"depth.png": depth, "depth.tiff": depth, "depth.pgm": depth, "grey.jpg": grey}
    for name, values in (pictures | {"metres.tiff": (depth / 1e3).astype(np.float32)}).items():
        Image.fromarray(values).save(folder / name)
        parts = (_chunks, _to_png) if name.endswith("png") else (None, bytes)
        targets.append(Target(name, (folder / name).read_bytes(), image, *parts))
    np.save(folder / "depth.npy", depth / 1e3)
    content = (folder / "depth.npy").read_bytes()
    return [*targets, Target("image/depth.npy", content, image, same=as_numpy)]


def _pool() -> ProcessPoolExecutor:
    """A process that may die."""
    return ProcessPoolExecutor(1, get_context("spawn"))


@click.command()
@click.option("--count", default=100_000, show_default=True, help="Number of inputs.")
@click.option("--seed", default=1, show_default=True)
@click.option("--only", default="", help="Targets whose name begins with this.")
@click.option("--out", type=click.Path(path_type=Path), help="JSON of all failures.")
def main(count: int, seed: int, only: str, out: Path | None) -> None:
    """Mutate, read, count."""
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    total, failures = Counter[str](), list[str]()
    with tempfile.TemporaryDirectory() as name:
        valid = Path(name)
        targets = all_targets(valid, seed)
        chosen = [n for n, one in enumerate(targets) if one.name.startswith(only)]
        shares = sum(targets[n].share for n in chosen)
        pool = _pool()
        for n in tqdm(chosen, disable=None):
            wanted = max(1, round(count * targets[n].share / shares))
            try:
                outcomes, failed = pool.submit(run_all, valid, n, seed, wanted).result()
            except BrokenProcessPool:
                outcomes, failed = Counter(died=1), [f"{targets[n].name}: the process died"]
                pool = _pool()
            click.echo(f"{targets[n].name:32} {dict(outcomes)}")
            total += outcomes
            failures += failed
        pool.shutdown()
    for failure in failures[:60]:
        click.echo(failure)
    click.echo(
        f"{total.total()} mutated inputs, seed {seed}: refused {total['refused']}, "
        f"accepted {total['accepted']}, failures {len(failures)}."
    )
    if out is not None:
        out.write_text(json.dumps({"outcomes": total, "failures": failures}), encoding="utf-8")


if __name__ == "__main__":
    main()
