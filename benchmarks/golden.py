"""What the program answers to twenty recordings, before a change and after it, number by number.

    python -m benchmarks.golden inputs FOLDER
    python -m benchmarks.golden run FOLDER OUT [--only NAME ...]
    python -m benchmarks.golden compare BEFORE AFTER [--only NAME ...]

`inputs` makes the recordings once: simulated, of the independent generator, a real Kinect's boards,
a real arm's walls, a bag and a folder of images. `run` gives them to the commands, all in one
process. `compare` prints the worst numbers by key, each in units of its tolerance, and every word
that differs. It ends with exit code 1 if any number is outside its tolerance, or any word differs.
"""

import contextlib
import io
import json
import math
import os
import re
import shutil
import sys
import traceback
from collections import Counter
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import click
import numpy as np
import yaml

SEED = 20261124
"""Of the generator's recordings: training data, never to be quoted."""

ROOT = Path(__file__).resolve().parents[1]
SIMULATED = ("demo", "set1", "set2", "set3", "repeats", "diagnosis", "long_range")
GENERATED = (("E", 0), ("E", 1), ("E", 2), ("O", 0), ("N", 0))
TRIALS = {
    f"arm_p{mount}": [f"L3CX_{wall}_P{mount}" for wall in ("R1", "R2", "W1", "W2")]
    for mount in (1, 2)
}
FORMATS = ("c.c", "lut.npz", "urdf.xacro", "tf.yaml", "easy_handeye.yaml", "opencv.yml")

IGNORED = ("*seconds*", "*versions*", "*created*", "*sha256*", "*path*", "*recordings*", "*wall_s*")
"""Keys that differ from run to run of one program."""

TOLERANCES: dict[str, tuple[float, float]] = {
    "*p_value*": (0.0, 0.02),  # resampled: six of 300 draws may fall on the other side
    "*score*": (0.05, 0.05),  # measured in draws whose directions rounding turns
    "*gain*": (1e-3, 0.011),  # written with two decimals
    "*probabilit*": (0.0, 0.01),  # resampled, as p-values
    "*ci*": (5e-3, 5e-3),  # quantiles of resamples lie between two neighbouring draws
    "*iterations*": (0.0, 20.0),  # a solver may take other steps to the same optimum
    "*undetermined*": (0.0, 1.0),  # directions at the limit of rounding
    "*noise*": (5e-3, 1e-6),  # two estimators of one noise model agree to the third digit
    "*floor*": (5e-3, 1e-3),  # follows the noise model
    "*_se*": (2e-3, 1e-7),  # weights follow the noise model
    "*_mm*": (1e-3, 1e-3),  # a micrometre: a thousandth of what any user can use
    "*share*": (1e-3, 1e-3),  # of squares that are known to this
    "*": (1e-3, 1e-6),  # sums in another order; solvers stop at 1e-4 of a standard error
}
"""How far a number may move, by the first pattern that its key matches.

As a share of the larger of both, and in the key's own unit.
"""

_TRAIN = "train --config {model} --recording {recording} --out {out}/run"
_COMMON = ("inspect {recording}", _TRAIN, "diagnose --recording {recording} --out {out}/diagnosis")
_MORE = {
    "demo": (
        "evaluate --config paper --recording {recording} --out {out}/evaluation",
        "check --run {out}/run --recording {recording} --out {out}/check.json",
        "correct --model {out}/run/corrector.ts --recording {recording} --out {out}/corrected",
        *(
            f"export --run {{out}}/run --format {f.split('.')[0]} --out {{out}}/export_{f}"
            for f in FORMATS
        ),
    ),
    "set3": (
        "select --config paper --recording {recording} --out {out}/selection",
        "check --run {out}/run --wall recorded --recording {recording} --out {out}/check.json",
        "diagnose --recording {recording} --sim {inputs}/set3_ideal --out {out}/against",
        "degrade --sensor {out}/against --recording {inputs}/set3_ideal --out {out}/degraded",
    ),
    "set1": ("diagnose --recording {recording} --sim demo --config many --out {out}/against",),
}
_IMPORTS = {
    "kinect": "import checkerboard {real}/kinect2_checkerboard --depth {{view}}_sync_depth.png"
    " --infrared {{view}}_sync_ir.png --board 5x7 --square-mm 30 --intrinsics kinect2",
    "arm_p1": "import distances {arm}",
    "arm_p2": "import distances {arm}",
    "bag": "import rosbag {inputs}/bag/drive --depth /camera/depth/image_raw"
    " --amplitude /camera/ir/image_raw --base-frame base_link --tool-frame tool0",
    "images": "import frames {inputs}/images --depth depth/*.png --amplitude ir/*.png"
    " --poses {inputs}/images/poses.txt --intrinsics {inputs}/images/K.yaml",
}


def _inputs() -> dict[str, tuple[str, ...]]:
    """Return every input whose data are there, and its commands; `{...}` are folders."""
    found: dict[str, tuple[str, ...]] = {
        name: (f"simulate --config {name} --out {{out}}/simulated", *_COMMON, *_MORE.get(name, ()))
        for name in SIMULATED
    }
    found |= {f"generated_{tier}{index}": _COMMON for tier, index in GENERATED}
    many = "diagnose --config many --recording {recording} --out {out}/diagnosis"
    for name, command in _IMPORTS.items():
        if "TOFCORR_REAL_DATA" in os.environ or name in {"bag", "images"}:
            last = () if name.startswith("arm") else (many,)
            found[name] = (command + " --out {out}/recording", *_COMMON[:2], *last)
    return found


@click.group(context_settings={"help_option_names": ["-h", "--help"]})
def group() -> None:
    """Freeze what the program answers, and compare it with what it answers after a change."""


_only = click.option("--only", multiple=True, help="Names of recordings; may be repeated.")


@group.command("inputs")
@click.argument("folder", type=click.Path(path_type=Path))
def inputs_command(folder: Path) -> None:
    """Make the recordings in FOLDER."""
    from benchmarks.renewed.cases import write_case

    folder.mkdir(parents=True)
    for name in SIMULATED:
        _call(f"simulate --config {name} --out {folder / name}".split())
    _write_ideal(folder / "set3", folder / "set3_ideal")
    for tier, index in GENERATED:
        entry = write_case(SEED, tier, index, folder / "generated")
        made = folder / "generated" / "recordings" / entry["id"]
        shutil.move(made, folder / f"generated_{tier}{index}")
    _write_drive(folder)


def _write_ideal(recording: Path, ideal: Path) -> None:
    """Write what an ideal camera would have recorded in place of a simulated one."""
    shutil.copytree(recording, ideal, ignore=shutil.ignore_patterns("truth"))
    distance = np.load(recording / "truth" / "radial_distance.npy").astype(np.float32)
    np.save(ideal / "depth.npy", distance)
    truth = yaml.safe_load((recording / "truth" / "truth.yaml").read_text())
    header = yaml.safe_load((ideal / "recording.yaml").read_text())
    header["tool_from_camera"] = truth["tool_from_camera"]
    (ideal / "recording.yaml").write_text(yaml.safe_dump(header))


def _write_drive(folder: Path) -> None:
    """Write a drive through a room as a bag, and as images with poses."""
    from PIL import Image
    from scipy.spatial.transform import Rotation

    sys.path.insert(0, str(ROOT / "tests"))
    from importing.posed_scene import Drive  # type: ignore[import-not-found]
    from importing.rosbag.written_bags import write_drive  # type: ignore[import-not-found]

    drive = Drive(stops=30, width=48, height=36, rate=5.0).record()
    write_drive(drive, folder / "bag", "mcap")
    out = folder / "images"
    for part, images in (("depth", drive.depth_mm), ("ir", drive.amplitude)):
        (out / part).mkdir(parents=True)
        for time_s, image in zip(drive.image_times, images, strict=True):
            Image.fromarray(image).save(out / part / f"{time_s:.6f}.png")
    rotation = Rotation.from_matrix(drive.world_from_tool[:, :3, :3]).as_quat()
    rows = np.column_stack([drive.pose_times, drive.world_from_tool[:, :3, 3], rotation])
    np.savetxt(out / "poses.txt", rows, fmt="%.9f")
    camera = {"K": drive.matrix.tolist(), "distortion": list(drive.distortion)}
    (out / "K.yaml").write_text(yaml.safe_dump(camera))


@group.command("run")
@click.argument("folder", type=click.Path(exists=True, path_type=Path))
@click.argument("out", type=click.Path(path_type=Path))
@_only
def run_command(folder: Path, out: Path, only: tuple[str, ...]) -> None:
    """Give the recordings of FOLDER to the commands; OUT gets what they write."""
    for name, commands in _inputs().items():
        if only and name not in only:
            continue
        own = out / name
        shutil.rmtree(own, ignore_errors=True)
        own.mkdir(parents=True)
        said = ""
        for command in commands:
            said += f"$ {command}\n{_call(_filled(command, name, folder, own))}\n"
        said = said.replace(str(own), "OUT").replace(str(folder), "IN")
        (own / "said.txt").write_text(said.removesuffix("\n"))
        _correct_some(own)
        click.echo(name)


def _filled(command: str, name: str, folder: Path, own: Path) -> list[str]:
    """Return the words of a command with its folders filled in."""
    real = Path(os.environ.get("TOFCORR_REAL_DATA", "."))
    trials = [str(real / "wall_trials_l3cx" / trial) for trial in TRIALS.get(name, ())]
    places = {
        "recording": own / "recording" if name in _IMPORTS else folder / name,
        "model": {"kinect": "ea_log", "generated_E1": "eb"}.get(name, "ea"),
        "view": "{view}",
        "out": own,
        "inputs": folder,
        "real": real,
    }
    words: list[str] = []
    for word in command.split():
        words += trials if word == "{arm}" else [word.format(**places)]
    if words[0] == "train" and name.startswith("arm"):
        words += ["--set", "model.terms=[{kind: distance_polynomial, degree: 1}]"]
    return words


def _call(words: list[str]) -> str:
    """Run one command of the program in this process; return what it printed and its exit code."""
    from tofcorr.cli.main import group as program

    heard, code = io.StringIO(), 0
    with contextlib.redirect_stdout(heard), contextlib.redirect_stderr(heard):
        try:
            program.main(words, prog_name="tofcorr", standalone_mode=False)
        except SystemExit as end:
            code = end.code
        except Exception as error:  # noqa: BLE001 - whatever a command ends with is its answer.
            code = 2
            print(f"{type(error).__name__}: {error}")
            if not re.search("Tofcorr|Click", str(type(error).__mro__)):
                traceback.print_exc()
    return f"{heard.getvalue()}exit {code or 0}"


def _correct_some(own: Path) -> None:
    """Write what the run's corrector makes of made-up frames."""
    import torch

    if not (own / "run" / "corrector.ts").exists():
        return
    corrector = torch.jit.load(str(own / "run" / "corrector.ts"))
    camera = yaml.safe_load((own / "run" / "calibration.yaml").read_text())["camera"]
    random = np.random.default_rng(SEED)
    shape = (3, camera["height"], camera["width"])
    drawn = [random.uniform(*ends, shape) for ends in ((0.3, 4.0), (0.0, 3000.0))]
    depth, amplitude = (torch.tensor(values, dtype=torch.float32) for values in drawn)
    with contextlib.suppress(RuntimeError, torch.jit.Error):  # A model of conditions asks for more.
        corrected, valid = corrector(depth, amplitude)
        np.savez(own / "corrected.npz", corrected_mm=1e3 * corrected.numpy(), valid=valid.numpy())


@group.command("compare")
@click.argument("before", type=click.Path(exists=True, path_type=Path))
@click.argument("after", type=click.Path(exists=True, path_type=Path))
@_only
def compare_command(before: Path, after: Path, only: tuple[str, ...]) -> None:
    """Compare two folders that `run` wrote."""
    names = only or tuple(path.name for path in sorted(after.iterdir()))
    numbers: list[tuple[float, str, Any, Any]] = []
    words: list[str] = []
    for name in names:
        one, other = _values(before / name), _values(after / name)
        answered = {key.split(":")[0] for key in other}
        # A command that was left out of the run answers nothing.
        keys = sorted(key for key in one.keys() | other.keys() if key.split(":")[0] in answered)
        for key in (k for k in keys if not any(fnmatch(k, pattern) for pattern in IGNORED)):
            a, b = one.get(key, "(missing)"), other.get(key, "(missing)")
            if isinstance(a, float) and isinstance(b, float):
                numbers.append((_off(key, a, b), f"{name}/{key}", a, b))
            elif a != b:
                words.append(f"{name}/{key}: {a!r} -> {b!r}")
    numbers.sort(key=lambda row: -row[0])
    outside = sum(off > 1 for off, *_ in numbers)
    click.echo(f"{len(numbers)} numbers, {outside} outside tolerance; {len(words)} words differ")
    click.echo("off/tolerance  key: before -> after")
    for off, key, a, b in numbers[:10]:
        click.echo(f"{off:13.3g}  {key}: {a:.9g} -> {b:.9g}")
    for line in words[:40]:
        click.echo(f"word  {line[:400]}")
    sys.exit(bool(outside or words))


def _off(key: str, a: float, b: float) -> float:
    """Return how far two numbers are apart, in units of the tolerance of their key."""
    if a == b or (math.isnan(a) and math.isnan(b)):
        return 0.0
    relative, absolute = next(TOLERANCES[one] for one in TOLERANCES if fnmatch(key.lower(), one))
    off = abs(a - b) / (absolute + relative * max(abs(a), abs(b)))
    return math.inf if math.isnan(off) else off


def _values(folder: Path) -> dict[str, Any]:
    """Return every number (float) and word of the files of a folder, by file and key."""
    found: dict[str, Any] = {}
    for path in sorted(folder.rglob("*")):
        key = f"{path.relative_to(folder)}:"
        if path.name == "said.txt":
            for said in path.read_text().split("$ ")[1:]:
                command, _, text = said.partition("\n")
                _flatten(f"said by {command}:", text, found)
        elif path.suffix in {".json", ".yaml", ".yml"}:  # JSON is YAML, but for its speed
            text = re.sub(r"^%YAML.*|!!opencv-matrix", "", path.read_text(), flags=re.MULTILINE)
            _flatten(key, (json.loads if path.suffix == ".json" else yaml.safe_load)(text), found)
        elif path.suffix in {".txt", ".md", ".csv", ".xacro"}:
            _flatten(key, path.read_text(), found)
        elif path.suffix == ".npy":
            _flatten_array(key, np.load(path), found)
        elif path.suffix == ".npz":
            for name, values in np.load(path).items():
                _flatten_array(f"{key}{name}", values, found)
    return found


def _flatten(key: str, value: object, found: dict[str, Any]) -> None:
    if isinstance(value, dict):
        for name, part in value.items():
            _flatten(f"{key}.{name}", part, found)
    elif isinstance(value, list):
        found[f"{key}.length"] = float(len(value))
        seen: Counter[str] = Counter()
        for number, part in enumerate(value):
            name = _name(part) or str(number)
            seen[name] += 1
            _flatten(f"{key}.{name}{seen[name] if seen[name] > 1 else ''}", part, found)
    elif isinstance(value, (int, float)) and not isinstance(value, bool):
        # An eigenvector has no sign.
        found[key] = abs(float(value)) if ".components." in key else float(value)
    elif isinstance(value, str):
        _flatten_text(key, value, found)
    else:
        found[key] = value


def _name(part: object) -> str:
    """Return what an entry of a list is about: entries may change places where they are equal."""
    words = part if isinstance(part, dict) else {}
    return " ".join(str(words[k]) for k in ("effect", "cause", "covariate", "kind") if k in words)


_NUMBER = re.compile(r"-?\d+(?:\.\d+)?(?:e[+-]?\d+)?")


def _flatten_text(key: str, text: str, found: dict[str, Any]) -> None:
    """Add the words of a text, and its numbers but for their last digit."""
    for number, line in enumerate(text.splitlines()):
        if re.search(r"\bseconds|\d s\b|it/s|%\|", line):
            continue
        found[f"{key}.{number}"] = _NUMBER.sub("#", re.sub(r"/\S*/", "", line))
        for place, digits in enumerate(_NUMBER.findall(line)):
            decimals = len(digits.partition(".")[2].partition("e")[0])
            # Rounded to its last digit: a number that is written is the middle of its digit.
            found[f"{key}.{number}.{place} (written)"] = round(float(digits), max(decimals - 1, 0))


def _flatten_array(key: str, values: np.ndarray, found: dict[str, Any]) -> None:
    """Add some sums of an array, which no change of one value leaves as they are."""
    if values.dtype.kind not in "fiub":
        return
    numbers = values.astype(float).ravel()
    seen, wave = np.isfinite(numbers), np.cos(np.arange(numbers.size))
    found |= {f"{key}.finite": float(seen.sum()), f"{key}.size": float(numbers.size)}
    if seen.any():
        found[f"{key}.rms"] = float(np.sqrt(np.mean(numbers[seen] ** 2)))
        found[f"{key}.wave"] = float(np.mean((numbers * wave)[seen]))


if __name__ == "__main__":
    group()
