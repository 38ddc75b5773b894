"""The commands that are killed: what they read, what they write, and when that is whole."""

import csv
import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import torch
import yaml
from PIL import Image

import tofcorr
from benchmarks import tiny
from tofcorr.correction.lookup import read_lut
from tofcorr.correction.metadata import load_corrector
from tofcorr.correction.state import load_calibration
from tofcorr.data.recording import Recording
from tofcorr.sensor.sensor_file import read_sensor

Check = Callable[[Path], object]


@dataclass(frozen=True)
class Command:
    """One command on a workspace of tiny files.

    Attributes:
        words: Its arguments; run in the workspace.
        out: What it writes, relative to the workspace.
        check: Reads what was written, and raises if that is not whole.
        resumes: Whether an interrupted run is filed, and gone on from with `--resume`.
        replaces: Whether an older file at `out` is there, and replaced.
    """

    words: tuple[str, ...]
    out: str
    check: Check
    resumes: bool = False
    replaces: bool = False

    @property
    def name(self) -> str:
        """For the summary."""
        marked = ("--resume", "--no-figures", "--ply")
        kind = [self.words[4]] if "--format" in self.words else []
        return " ".join([self.words[0], *kind, *(one for one in marked if one in self.words)])


def prepare(folder: Path, seed: int) -> None:
    """Write the workspace that every command starts from."""
    made = tiny.make(folder, seed)
    for extra in (made.full, made.module, made.lut):
        shutil.rmtree(extra) if extra.is_dir() else extra.unlink()
    simulator = yaml.safe_dump(tiny.simulator(seed + 1))
    (folder / "simulator.yaml").write_text(simulator, encoding="utf-8")
    sensor = yaml.safe_load(made.sensor.read_text(encoding="utf-8"))
    truth = yaml.safe_load((made.recording / "recording.yaml").read_text(encoding="utf-8"))
    sensor["camera"], sensor["depth_kind"] = truth["camera"], truth["depth_kind"]
    made.sensor.write_text(yaml.safe_dump(sensor), encoding="utf-8")
    (folder / "camera.yaml").write_text(yaml.safe_dump(truth["camera"]), encoding="utf-8")
    _scene(made.recording, folder / "scene")
    (folder / "old.json").write_text('{"old": true}\n', encoding="utf-8")


def commands() -> list[Command]:
    """Return the commands with their files."""
    read = ("--recording", "recording")
    train = ("train", *read, "--out", "new")
    export = [
        ("torchscript", "new.ts", load_corrector),
        ("lut", "new.npz", read_lut),
        ("urdf", "new.urdf", _xml),
        ("tf", "new.yaml", _yaml),
        ("easy_handeye", "new.yaml", _yaml),
        ("opencv", "new.yaml", lambda path: _starts(path, "%YAML")),
        ("c", "new.c", lambda path: _starts(path, "/")),
    ]
    some = ("--set", "folds=2", "--set", "models=[{name: E0, model: {terms: []}}]")
    older, correct = ("--out", "old.json"), ("correct", "--model", "run/corrector.ts")
    view = ("--size", "12", "10", "--distance", "0.5", "2")
    new = ("--out", "new")
    return [
        Command(("simulate", "--config", "simulator.yaml", *new), "new", _recording),
        Command(("import", "bop", "scene", *new), "new", _recording),
        Command(("inspect", "recording", "--out", "new.html"), "new.html", _page),
        Command((*train, "--no-figures"), "new", _run, resumes=True),
        Command(train, "new", _run),
        Command((*train, "--no-figures", "--resume", "run"), "new", _run, resumes=True),
        Command(("evaluate", *read, *some, *new), "new", _tables),
        Command(("select", *read, *some, *new), "new", _tables),
        Command(("check", "--run", "run", *read, *older), "old.json", _json, replaces=True),
        *(
            Command(("export", "--run", "run", "--format", kind, "--out", out), out, check)
            for kind, out, check in export
        ),
        Command((*correct, *read, *new), "new", _recording),
        Command((*correct, *read, "--ply", "new"), "new", _clouds),
        Command(("degrade", "--sensor", "sensor.yaml", *read, *new), "new", _recording),
        Command(
            ("poses", "--intrinsics", "camera.yaml", *view, "--number", "4", "--out", "new.csv"),
            "new.csv",
            _poses,
        ),
        Command(("diagnose", *read, "--set", "bootstraps=20", *new), "new", _diagnosis),
    ]


def _scene(recording: Path, folder: Path) -> None:
    """Write a recording as a scene of BOP, whose importer finds the wall."""
    opened = Recording.open(recording)
    truth = yaml.safe_load((recording / "truth" / "truth.yaml").read_text(encoding="utf-8"))
    (folder / "depth").mkdir(parents=True)
    images = {}
    poses = opened.frames.world_from_tool @ np.array(truth["tool_from_camera"])
    for number, (depth, pose) in enumerate(zip(opened.depth, poses, strict=True)):
        counts = np.nan_to_num(np.array(depth) * 1e4).astype(np.uint16)
        Image.fromarray(counts).save(folder / "depth" / f"{number:06d}.png")
        inverse = np.linalg.inv(pose)
        images[str(number)] = {
            "cam_K": np.ravel(opened.camera.matrix).tolist(),
            "depth_scale": 0.1,
            "cam_R_w2c": inverse[:3, :3].ravel().tolist(),
            "cam_t_w2c": (1e3 * inverse[:3, 3]).tolist(),
        }
    (folder / "scene_camera.json").write_text(json.dumps(images), encoding="utf-8")


def _recording(path: Path) -> None:
    Recording.open(path)


def _run(path: Path) -> None:
    state = load_calibration(path / "state.pt")
    report = _json(path / "report.json")
    _yaml(path / "calibration.yaml")
    if report["verdict"] != "do not use":
        load_corrector(path / "corrector.ts")
    module = tofcorr.DepthCorrection.load(path)
    if not torch.equal(module.hand_eye().detach(), state.tool_from_camera):
        raise ValueError("module and state disagree")


def _tables(path: Path) -> None:
    if not list(path.iterdir()):
        raise ValueError("an empty report")
    for file in path.rglob("*.json"):
        _json(file)


def _diagnosis(path: Path) -> None:
    if _json(path / "diagnosis.json")["format"] != "tofcorr-diagnosis":
        raise ValueError("no diagnosis")
    _page(path / "report.html")
    read_sensor(path / "sensor.yaml")


def _clouds(path: Path) -> None:
    for file in path.glob("*.ply"):
        content = file.read_bytes()
        head, _, body = content.partition(b"end_header\n")
        vertices = int(head.split(b"element vertex ")[1].split()[0])
        if not vertices or len(body) % vertices:
            raise ValueError(f"{file.name} is cut short")


def _json(path: Path) -> dict:
    return json.loads(path.read_text(encoding="utf-8"))


def _yaml(path: Path) -> None:
    if not isinstance(yaml.safe_load(path.read_text(encoding="utf-8")), dict):
        raise TypeError(f"{path.name}: no keys and values")


def _xml(path: Path) -> None:
    ElementTree.parse(path)


def _page(path: Path) -> None:
    if not path.read_text(encoding="utf-8").rstrip().endswith("</html>"):
        raise ValueError(f"{path.name} is cut short")


def _starts(path: Path, text: str) -> None:
    content = path.read_text(encoding="utf-8")
    if not content.startswith(text) or not content.endswith("\n"):
        raise ValueError(f"{path.name} is cut short")


def _poses(path: Path) -> None:
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.reader(file))
    if len({len(row) for row in rows}) != 1 or len(rows) < 3:
        raise ValueError(f"{path.name} is cut short")
