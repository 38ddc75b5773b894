"""What is left of files when a command is killed, or the disk is full: the old, nothing, or all.

Every command runs on a tiny recording, in a process of its own. At one of its operations on files,
drawn at random, it is ended by a signal, or from then on no file can be opened for want of space.
Then what was there before must be there unchanged (a file that the command replaces is old or
new); at the place of its output there is nothing, or all of it; after SIGTERM and SIGINT no
temporary file is left; and a run again succeeds and removes what SIGKILL left. `TOFCORR_KILLS` is
the number of kills of each command.
"""

import csv
import hashlib
import json
import os
import random
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from xml.etree import ElementTree

import pytest
import yaml

import tofcorr
from benchmarks import tiny
from tofcorr.correction.lookup import read_lut
from tofcorr.data.recording import Recording
from tofcorr.module.loading import load_corrector
from tofcorr.sensor.sensor_file import read_sensor

KILLS = int(os.environ.get("TOFCORR_KILLS", "1"))
SIGNALS = {"KILL": {-9}, "TERM": {-15, 130, 2}, "INT": {130, 2}, "": {2}}  # exit codes of each
# Counts the operations on files of a folder, and lets something happen at one of them.
PROGRAM = """
import errno, os, signal, sys
what, moment, *words = sys.argv[1:]
number, here = 0, os.getcwd()
changing = {"os.rename", "os.mkdir", "os.rmdir", "os.remove", "shutil.rmtree"}
def hook(event, given):
    global number
    if event == "open":
        changes = isinstance(given[2], int) and given[2] & (os.O_WRONLY | os.O_RDWR | os.O_CREAT)
    else:
        changes = event in changing
    if not changes or not isinstance(given[0], str | bytes | os.PathLike):
        return
    if not os.path.abspath(os.fsdecode(given[0])).startswith(here):
        return
    number += 1
    if what and number == int(moment):
        os.kill(os.getpid(), getattr(signal, "SIG" + what))
    if not what and number >= int(moment) and event in ("open", "os.mkdir"):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
import tofcorr.cli.main
sys.argv = ["tofcorr", *words]
sys.addaudithook(hook)
try:
    tofcorr.cli.main.main()
finally:
    print("operations", number, flush=True)
"""


def _yaml(path: Path) -> None:
    assert isinstance(yaml.safe_load(path.read_text(encoding="utf-8")), dict)


def _page(path: Path) -> None:
    assert path.read_text(encoding="utf-8").rstrip().endswith("</html>")


def _ends(path: Path) -> None:
    assert path.read_text(encoding="utf-8").endswith("\n")


def _run(path: Path) -> None:
    report = json.loads((path / "report.json").read_text(encoding="utf-8"))
    _yaml(path / "calibration.yaml")
    if report["verdict"] != "do not use":
        load_corrector(path / "corrector.ts")
    tofcorr.DepthCorrection.load(path)


def _tables(path: Path) -> None:
    assert list(path.iterdir())
    for file in path.rglob("*.json"):
        json.loads(file.read_text(encoding="utf-8"))


def _diagnosis(path: Path) -> None:
    _tables(path)
    _page(path / "report.html")
    read_sensor(path / "sensor.yaml")


def _clouds(path: Path) -> None:
    for file in path.glob("*.ply"):
        head, _, body = file.read_bytes().partition(b"end_header\n")
        vertices = int(head.split(b"element vertex ")[1].split()[0])
        assert vertices
        assert len(body) % vertices == 0


def _poses(path: Path) -> None:
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.reader(file))
    assert len({len(row) for row in rows}) == 1
    assert len(rows) >= 3


RUN, RECORDING = "--run run", "--recording recording"
COMMANDS: dict[str, Callable[[Path], object]] = {
    "simulate --config simulator.yaml --out new": Recording.open,
    "inspect recording --out new.html": _page,
    f"train {RECORDING} --out new --no-figures": _run,
    f"evaluate {RECORDING} --config few.yaml --out new": _tables,
    f"select {RECORDING} --config few.yaml --out new": _tables,
    f"check {RUN} {RECORDING} --out old.json": _yaml,
    f"export {RUN} --format torchscript --out new.ts": load_corrector,
    f"export {RUN} --format lut --out new.npz": read_lut,
    f"export {RUN} --format urdf --out new.urdf": ElementTree.parse,
    f"export {RUN} --format tf --out new.yaml": _yaml,
    f"export {RUN} --format c --out new.c": _ends,
    f"correct --model run/corrector.ts {RECORDING} --out new": Recording.open,
    f"correct --model run/corrector.ts {RECORDING} --ply new": _clouds,
    f"degrade --sensor sensor.yaml {RECORDING} --out new": Recording.open,
    "poses --intrinsics camera.yaml --size 12 10 --distance 0.5 2 --number 4 --out new.csv": _poses,
    f"diagnose {RECORDING} --set bootstraps=20 --out new": _diagnosis,
}
"""Commands in the workspace, and what reads whole what each writes."""


@pytest.fixture(scope="module")
def ready(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The workspace that every command starts from."""
    folder = tmp_path_factory.mktemp("ready")
    tiny.make(folder, 1)
    header = yaml.safe_load((folder / "recording" / "recording.yaml").read_text(encoding="utf-8"))
    sensor = yaml.safe_load((folder / "sensor.yaml").read_text(encoding="utf-8"))
    sensor |= {"camera": header["camera"], "depth_kind": header["depth_kind"]}
    texts = {
        "sensor.yaml": sensor,
        "camera.yaml": header["camera"],
        "simulator.yaml": tiny.simulator(2),
        "few.yaml": {"folds": 2, "models": [{"name": "E0", "model": {"terms": []}}]},
        "old.json": {"old": True},
    }
    for name, values in texts.items():
        (folder / name).write_text(yaml.safe_dump(values), encoding="utf-8")
    return folder


def run(words: str, ready: Path, place: Path, what: str, moment: int) -> tuple[int, str]:
    """Run a command in a copy of the workspace; return exit code and what it printed."""
    folder, scratch = place / "work", place / "scratch"
    if not folder.exists():
        shutil.copytree(ready, folder)
    scratch.mkdir(exist_ok=True)
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, what, str(moment), *words.split()],
        cwd=folder,
        env=os.environ | {"TMPDIR": str(scratch), "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        timeout=900,
        check=False,
    )
    return done.returncode, done.stdout + done.stderr


def digests(folder: Path) -> dict[str, str]:
    """The digest of every file, by its path; temporary ones left out."""
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in folder.rglob("*")
        if path.is_file() and ".tofcorr-" not in str(path)
    }


def hidden(place: Path) -> list[str]:
    """Temporary files that a run left, also among the system's."""
    found = [path.name for path in (place / "work").iterdir() if ".tofcorr-" in path.name]
    return found + [path.name for path in (place / "scratch").glob("tofcorr-scratch-*")]


@pytest.mark.slow
@pytest.mark.parametrize("words", COMMANDS)
def test_a_killed_command_leaves_nothing_or_all(words: str, ready: Path, tmp_path: Path) -> None:
    check, draw = COMMANDS[words], random.Random(words)
    written = words.split(" --ply " if "--ply" in words else " --out ")[1].split(maxsplit=1)[0]
    code, told = run(words, ready, tmp_path / "whole", "", 10**9)
    assert code == 0, told
    check(tmp_path / "whole" / "work" / written)
    operations = int(told.split("operations ")[1].split()[0])
    before = digests(ready)
    for number in range(KILLS):
        what, place = draw.choice(list(SIGNALS)), tmp_path / str(number)
        code, told = run(words, ready, place, what, draw.randint(1, operations))
        assert code in {0, *SIGNALS[what]}, told
        assert "Traceback" not in told
        after, out = digests(place / "work"), place / "work" / written
        others = {path: digest for path, digest in before.items() if path != written}
        assert {path: after.get(path) for path in others} == others
        if os.path.lexists(out):
            check(out)
        else:
            assert written not in before
        left = hidden(place)
        assert not left or what == "KILL" or code < 0
        shutil.rmtree(out) if out.is_dir() else out.unlink(missing_ok=True)
        code, told = run(words, ready, place, "", 10**9)
        assert code == 0, told
        assert not hidden(place)
        assert not left or "Removed" in told
        check(out)
