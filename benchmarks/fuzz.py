"""What comes of mutated inputs: of every format that tofcorr reads, and the front of its commands.

    python -m benchmarks.fuzz --count 100000 --seed 1 --out fuzz.json

Each input is a valid file with one to three changes: of bytes, of cells, of keys and values, or of
arrays. Hypothesis draws them (`benchmarks.fuzz_by_branches` has libFuzzer draw for it). An input
must be refused in one sentence, or be read. Counted as failures are tracebacks,
processes that die, more than 20 s of CPU, more than 2 GB of memory, messages of several lines,
and files that are written elsewhere.
"""

import contextlib
import copy
import io
import json
import math
import os
import resource
import signal
import sys
import tempfile
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from shutil import copytree, rmtree
from typing import Any

import click
import hypothesis
import numpy as np
import torch
import yaml
from hypothesis import strategies as st
from PIL import Image
from tqdm import tqdm

import tofcorr
from benchmarks import tiny
from benchmarks.timing import write
from tofcorr.comparison.options import EvaluationOptions, SelectionOptions
from tofcorr.correction.corrector import DepthCorrector
from tofcorr.correction.lookup import read_lut
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
from tofcorr.module.loading import load_corrector
from tofcorr.options import Options, resolve_options, shipped_names
from tofcorr.pixels.dataset import Dataset
from tofcorr.plausibility.examine import examine
from tofcorr.simulation.options import SimulatorOptions
from tofcorr.simulation.simulator import simulate
from tofcorr.training.calibration import TrainingOptions
from tofcorr.training.run import train

SECONDS, MEMORY, LONGEST_MESSAGE = 20.0, 2 * 2**30, 5000
WORDS = [  # text that a program may take for something else
    *("", " ", "nan", "1e999", "1_0", "0x1p4", "null", "\u0663", "a\nb", "\x1b[31m", "x" * 3000),
    *("amplitude", "radial", "z", "auto", "none", "white", "../..", "\ud7ff\U0001f600"),
]
NUMBERS = st.floats() | st.integers() | st.sampled_from([10**6, 10**30, 10**400, 1e12, 1.1e12])
HOSTILE = st.recursive(
    st.none() | st.booleans() | NUMBERS | st.sampled_from(WORDS) | st.text(max_size=9),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner),
    max_leaves=4,
)
"""Values that a file may hold anywhere and that a program may not expect."""
TOKENS = [  # bytes that mean something in one of the formats of text
    *(b"\x00", b"\xff\xfe", b"\n", b"\r", b",", b";", b":", b"-", b"#", b'"', b"'", b"[", b"}"),
    *(b"nan", b"inf", b"-inf", b"1e309", b"1e-320", b"0x10", b"1_0", b"9" * 400, b"-0", b"1e30"),
    *(b"!!python/object:os.system ", b"!!bool ", b"&a ", b"*a ", b"<<: ", b"\xe2\x80\xa8"),
    *(b"\t", b"{" * 200, b"[" * 2000, b"%", b"true", b"null", b"~", b"\xef\xbb\xbf", b"\xc3"),
]
FACTORS = (-1, 0, 10, 1000, 1e6, 1e-6, 1e15, -1e300, 1.01, 1e-200, math.inf, math.nan)
KINDS = (torch.float32, torch.int64, torch.bool, torch.complex128)
FRAMES = (
    torch.linspace(0.3, 3.0, 120).reshape(10, 12),
    torch.linspace(10.0, 5e4, 120).reshape(10, 12).flip(0),
)


@dataclass(frozen=True)
class Target:
    """One file, and one way to read it.

    Attributes:
        name: Of the file.
        content: A valid one.
        read: Reads a file; raises a `TofcorrError` if the input is refused.
        share: Of all inputs, relative to the others'.
    """

    name: str
    content: bytes
    read: Callable[[Path], Any]
    share: float = 3.0


# The formats: how a file becomes lists, mappings and tensors, and is written again.


def _to_csv(rows: Any) -> str:  # noqa: ANN401 - any value
    lines = [row if isinstance(row, list) else [row] for row in rows or [] if row != []]
    return "\n".join(",".join(map(str, line)) for line in lines)


def _load_array(content: bytes) -> Any:  # noqa: ANN401 - a tensor, or a mapping of some
    loaded = np.load(io.BytesIO(content))
    if isinstance(loaded, np.ndarray):
        return torch.from_numpy(loaded)
    return {k: str(v) if v.dtype.kind == "U" else torch.from_numpy(v) for k, v in loaded.items()}


def _saved(save: Callable[[Any, Any], Any], values: Any) -> bytes:  # noqa: ANN401 - any value
    written = io.BytesIO()
    save(values, written)
    return written.getvalue()


def _save_array(values: Any, file: Any) -> None:  # noqa: ANN401 - any value
    if isinstance(values, dict):
        arrays: Any = {str(name): np.asarray(one) for name, one in values.items()}
        np.savez(file, **arrays)
    else:
        np.save(file, np.asarray(values), allow_pickle=False)


FORMATS: dict[str, tuple[Callable[[bytes], Any], Callable[[Any], bytes | str]]] = {
    ".yaml": (yaml.safe_load, partial(yaml.safe_dump, allow_unicode=True)),
    ".json": (json.loads, partial(json.dumps, default=str)),
    ".csv": (lambda content: [x.split(",") for x in content.decode().splitlines()], _to_csv),
    **dict.fromkeys((".npy", ".npz"), (_load_array, partial(_saved, _save_array))),
    ".pt": (
        lambda content: torch.load(io.BytesIO(content), weights_only=True),
        partial(_saved, torch.save),
    ),
}


def dumped(name: str, tree: Any) -> bytes:  # noqa: ANN401 - any value
    """The file of this name that holds a tree."""
    content = FORMATS[Path(name).suffix][1](tree)
    return content.encode("utf-8", "surrogatepass") if isinstance(content, str) else content


# Changes, as strategies of Hypothesis.


@st.composite
def edited(draw: st.DrawFn, content: bytes) -> bytes:
    """Bytes of which some are overwritten, inserted, cut out, repeated or cut off."""
    for _ in range(draw(st.integers(1, 3))):
        start = draw(st.integers(0, len(content)))
        end = start + draw(st.sampled_from([0, 1, 4, 32, 256, len(content)]))
        tokens = st.sampled_from([b"", 2 * content[start:end], *TOKENS])
        content = content[:start] + draw(tokens | st.binary(max_size=64)) + content[end:]
    return content


@st.composite
def changed(draw: st.DrawFn, tree: Any) -> Any:  # noqa: ANN401 - any value
    """Lists and mappings, of which one to three entries are others, gone or more."""
    holder = {"": copy.deepcopy(tree)}
    for _ in range(draw(st.integers(1, 3))):
        place, key = draw(st.sampled_from(list(_entries(holder))))
        kind, new = draw(st.integers(0, 4)), copy.deepcopy(draw(_others(place[key])))
        if kind < 3 or key == "":
            place[key] = new
        elif kind == 3:
            del place[key]
        elif isinstance(place, list):
            place.insert(draw(st.integers(0, len(place))), new)
        else:
            place[draw(st.sampled_from(["unknown", str(key)[:-1], str(key).upper(), 3]))] = new
    return holder[""]


def _entries(tree: Any) -> Iterator[tuple[Any, Any]]:  # noqa: ANN401 - any value
    for key in list(tree) if isinstance(tree, dict) else range(len(tree)):
        yield tree, key
        if isinstance(tree[key], dict | list):
            yield from _entries(tree[key])


def _others(value: Any) -> st.SearchStrategy[Any]:  # noqa: ANN401 - any value
    """What may stand in place of a value."""
    others: list[Any] = [[value], [value, value], {"a": value}, str(value)]
    if isinstance(value, torch.Tensor):
        others = [value[None], value.flatten()[:0], value.flatten().flip(0).reshape(value.shape)]
        others += [value * factor for factor in FACTORS] + [*map(value.to, KINDS)]
    elif isinstance(value, int | float):
        others += [value * factor for factor in FACTORS]
    return st.sampled_from(others) | HOSTILE


@st.composite
def mutated(draw: st.DrawFn, target: Target) -> bytes:
    """A mutated file of a target."""
    load, _ = FORMATS.get(Path(target.name).suffix, (None, None))
    if load is None or draw(st.booleans()):
        return draw(edited(target.content))
    try:
        return dumped(target.name, draw(changed(load(target.content))))
    except (TypeError, ValueError, OverflowError, AttributeError, yaml.YAMLError):
        hypothesis.reject()  # the format cannot say it


# One input, and what comes of it.


class WroteOutsideError(Exception):
    """Something was written elsewhere."""


def keep_inside(folder: Path) -> None:
    """From now on, work in a folder, and refuse to change files outside of it."""
    writing = os.O_WRONLY | os.O_RDWR | os.O_CREAT
    changes = {"os.mkdir", "os.remove", "os.rename", "os.rmdir", "os.link", "os.symlink"}

    def check(event: str, told: tuple[Any, ...]) -> None:
        if event in changes or (event == "open" and told[2] & writing):
            paths = [one for one in told[:2] if isinstance(one, str | bytes | os.PathLike)]
            # The second word about a file that is opened is how.
            for path in paths[: 1 if event == "open" else 2]:
                if not os.path.realpath(os.fsdecode(path)).startswith((str(folder), "/dev/")):
                    raise WroteOutsideError(f"{event} of {path!r}")

    os.chdir(folder)
    tempfile.tempdir = str(folder)
    sys.addaudithook(check)


def outcome(target: Target, folder: Path, content: bytes) -> tuple[str, str]:
    """Read one input; say what came of it, and where."""
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
            target.read(path)
    except TofcorrError as error:
        whole = "\n" not in str(error) and len(str(error)) <= LONGEST_MESSAGE
        return ("refused", "") if whole else ("not one sentence", str(error)[:300])
    except BaseException as error:  # noqa: BLE001 - any traceback is what is looked for
        own = [x for x in traceback.extract_tb(error.__traceback__) if "/tofcorr/" in x.filename]
        where = f"{own[-1].filename}:{own[-1].lineno}" if own else "outside"
        return "failed", f"{where} {type(error).__name__}: {error}"[:300]
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
    return "accepted", ""


def run_all(valid: Path, number: int, seed: int, count: int) -> tuple[Counter[str], list[str]]:
    """Fuzz one target in this process; return the outcomes, and what failed how."""
    outcomes, failures = Counter[str](), list[str]()
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)  # what libraries print
    sys.dont_write_bytecode = True
    target, folder = all_targets(valid, seed)[number], valid.resolve() / "inputs"
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
    most = pages * resource.getpagesize() + MEMORY
    resource.setrlimit(resource.RLIMIT_AS, (most, resource.RLIM_INFINITY))
    folder.mkdir(exist_ok=True)
    keep_inside(folder)

    @hypothesis.seed(seed)
    @hypothesis.settings(
        max_examples=count,
        database=None,
        deadline=None,
        phases=[hypothesis.Phase.generate],
        suppress_health_check=list[Any](hypothesis.HealthCheck),
    )
    @hypothesis.given(mutated(target))
    def test(content: bytes) -> None:
        kind, where = outcome(target, folder, content)
        outcomes[kind] += 1
        if where:
            failures.append(f"{target.name}: {kind}: {where}")

    test()
    return outcomes, failures


# The targets.


def all_targets(folder: Path, seed: int) -> list[Target]:
    """Return every target, with the valid files that it mutates in a folder."""
    made = tiny.make(folder, seed)
    return [*recordings(made), *archives(made), *configurations(made), *imports()]


def _within(folder: Path, use: Callable[[Path], Any]) -> Callable[[Path], Any]:
    """Use a recording in which one file is another."""

    def read(path: Path) -> Any:  # noqa: ANN401 - what the use returns
        whole = path.with_name(folder.name)
        copytree(folder, whole, dirs_exist_ok=True)
        (whole / path.name).write_bytes(path.read_bytes())
        return use(whole)

    return read


def _looked_at(path: Path) -> object:
    return examine(Dataset((Recording.open(path),)), "known")


def _trained_on(path: Path) -> object:
    return train(path, resolve_options(TrainingOptions, "e0", ("advice=0", "figures=false")))


def recordings(made: Path) -> list[Target]:
    """The files of a recording, read with all others, and what commands do with it first."""
    full, depth = made / "full", (made / "recording" / "depth.npy").read_bytes()
    uses = [_within(made / "recording", use) for use in (_looked_at, _trained_on)]
    opened = _within(full, Recording.open)
    return [
        *(Target(one.name, one.read_bytes(), opened, 8) for one in sorted(full.iterdir())),
        *(Target("depth.npy", depth, use, 0.8) for use in uses),
    ]


def _state(path: Path) -> object:
    corrector = DepthCorrector.from_state(load_calibration(path))
    corrector.metadata()
    return corrector(*FRAMES)


def archives(made: Path) -> list[Target]:
    """The binary files that tofcorr writes itself."""
    readers: dict[str, Callable[[Path], Any]] = {
        "run/state.pt": _state,
        "module.pt": lambda path: tofcorr.DepthCorrection.load(path)(*FRAMES),
        "run/corrector.ts": lambda path: load_corrector(path)(*FRAMES),
        "corrector.npz": lambda path: read_lut(path)(*(one.numpy() for one in FRAMES)),
    }
    named = {made / name: read for name, read in readers.items()}
    return [Target(path.name, path.read_bytes(), read, 10) for path, read in named.items()]


def _simulated(path: Path) -> object:
    options = resolve_options(SimulatorOptions, path)
    robot, camera = options.robot, options.camera
    frames = sum(shot.poses for shot in options.shots) + robot.repeat_poses * robot.repeat_frames
    if frames > 60 or camera.width * camera.height > 1000:  # only read, not run
        return options
    rmtree(path.with_name("simulated"), ignore_errors=True)
    return simulate(options, path.with_name("simulated"))


def _by_words(path: Path) -> object:
    words = path.read_text("utf-8", "replace").split("\n")
    return resolve_options(TrainingOptions, "ea", tuple(words))


def _sensed(path: Path) -> tofcorr.SensorModel:
    sensor = tofcorr.SensorModel.load(path)
    sensor(*FRAMES, generator=torch.Generator().manual_seed(1))
    return sensor


def configurations(made: Path) -> list[Target]:
    """Configurations, a sensor, a simulator that runs, and changes by `--set`."""
    sensor = yaml.safe_load((made / "sensor.yaml").read_text(encoding="utf-8"))
    sensor["camera"] |= {"width": 12, "height": 10}
    words = b"outlier_window_mm=80\nmodel.terms.0.degree=3\nsolver.kind=lbfgs"
    simulator = dumped("simulator.yaml", tiny.simulator(1))
    found = [
        Target("set.txt", words, _by_words),
        Target("simulator.yaml", simulator, _simulated, 0.4),
        Target("sensor.yaml", dumped("sensor.yaml", sensor), _sensed),
    ]
    classes: list[type[Options]] = [TrainingOptions, EvaluationOptions, SelectionOptions]
    for cls in [*classes, DiagnosisOptions, SimulatorOptions]:
        for name in shipped_names(cls.config_folder)[:4]:
            # All keys with their defaults, so that those that no file names are changed too.
            file = f"{cls.config_folder}_{name}.yaml"
            content = dumped(file, resolve_options(cls, name).to_mapping())
            found.append(Target(file, content, partial(resolve_options, cls), 2))
    return found


def _image(path: Path) -> np.ndarray:
    try:
        return read_grey(path) if path.suffix == ".jpg" else read_array(path)
    except RefusedViewError as error:
        raise TofcorrError(str(error)) from None


K = [365.5, 0.0, 255.5, 0.0, 366.5, 205.0, 0.0, 0.0, 1.0]
POSES = [[0.1 * n, 0.1 * n, 0.2, 1.0, 0.0, 0.0, 0.0, 1.0] for n in range(6)]
ROS = {
    "image_width": 512,
    "image_height": 424,
    "camera_matrix": {"rows": 3, "cols": 3, "data": K},
    "distortion_coefficients": {"rows": 1, "cols": 4, "data": [0.09, -0.27, 0, 0]},
    "distortion_model": "plumb_bob",
}
OPENCV = f"""%YAML:1.0
---
image_width: 512
image_height: 424
cameraMatrix: !!opencv-matrix {{rows: 3, cols: 3, dt: d, data: {K}}}
"""
SCENE = {
    "cam_K": K,
    "depth_scale": 0.1,
    "cam_t_w2c": K[:3],
    "cam_R_w2c": np.eye(3).ravel().tolist(),
}
IMPORTED: dict[str, tuple[Callable[[Path], Any], Any]] = {
    "tum.txt": (read_poses, "\n".join(" ".join(map(str, row)) for row in POSES)),
    "poses.csv": (read_poses, [["timestamp_s", "tx", "ty", "tz", "qx", "qy", "qz", "qw"], *POSES]),
    "poses.npy": (read_poses, np.tile(np.eye(4), (6, 1, 1))),
    "samples.yaml": (read_poses, [{"effector_wrt_world": np.eye(4).ravel().tolist()}] * 3),
    "own.yaml": (read_intrinsics, {"width": 512, "height": 424, "K": [K[:3], K[3:6], K[6:]]}),
    "numbers.json": (read_intrinsics, {"width": 512, "height": 424, "camera_matrix": K}),
    "ros.yaml": (read_intrinsics, ROS),
    "opencv.yaml": (read_intrinsics, OPENCV),
    "scene_camera.json": (read_scene_camera, {str(n): SCENE for n in range(3)}),
    "measurements.csv": (
        lambda path: read_distances(path, np.arange(4).reshape(2, 2), (), []),
        [list("tabcd"), *([0.5 + n / 100, n, n + 1, n + 2, 400] for n in range(8))],
    ),
}
"""What other programs write, and what reads it."""


def imports() -> list[Target]:
    """What other programs write, and importers read."""
    found = []
    for name, (read, given) in IMPORTED.items():
        content = given.encode() if isinstance(given, str) else dumped(name, given)
        found.append(Target(name, content, read))
    depth = np.linspace(400, 4000, 120, dtype=np.uint16).reshape(10, 12)
    grey = np.dstack([(depth // 16).astype(np.uint8)] * 3)
    pictures = {"depth.png": depth, "depth.tiff": depth, "depth.ppm": depth, "grey.jpg": grey}
    for name, values in (pictures | {"metres.tiff": (depth / 1e3).astype(np.float32)}).items():
        written = io.BytesIO()
        Image.fromarray(values).save(written, Image.registered_extensions()[Path(name).suffix])
        found.append(Target(name, written.getvalue(), _image))
    content = dumped("depth.npy", depth / 1e3)
    return [*found, Target("image/depth.npy", content, _image)]


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
        targets = all_targets(Path(name), seed)
        chosen = [n for n, one in enumerate(targets) if one.name.startswith(only)]
        shares = sum(targets[n].share for n in chosen)
        pool = ProcessPoolExecutor(1, get_context("spawn"))
        for n in tqdm(chosen, disable=None):
            wanted = max(1, round(count * targets[n].share / shares))
            try:
                outcomes, failed = pool.submit(run_all, Path(name), n, seed, wanted).result()
            except BrokenProcessPool:
                outcomes, failed = Counter(died=1), [f"{targets[n].name}: the process died"]
                pool = ProcessPoolExecutor(1, get_context("spawn"))
            click.echo(f"{targets[n].name:32} {dict(outcomes)}")
            total += outcomes
            failures += failed
        pool.shutdown()
    click.echo("\n".join(failures[:60]))
    click.echo(
        f"{total.total()} mutated inputs, seed {seed}: refused {total['refused']}, "
        f"accepted {total['accepted']}, failures {len(failures)}."
    )
    write({"outcomes": total, "failures": failures}, out)


if __name__ == "__main__":
    main()
