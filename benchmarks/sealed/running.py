"""Run the program under test on every recording of a manifest; it sees the recordings alone.

An entry with `sim` names the simulator's recording, one with `held_out` ideal frames to be degraded
by the camera that the diagnosis found.
"""

import contextlib
import json
import multiprocessing
import os
import shutil
import signal
import sys
import time
import traceback
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from benchmarks.renewed.recording import read
from benchmarks.sealed.answers import Entry, digest, entries_of


def waiting(out: Path) -> list[Entry]:
    """Entries of the manifest that have no run record yet."""
    return [one for one in entries_of(out) if not (out / "runs" / f"{one['id']}.json").exists()]


def diagnose(
    out: Path, entries: Sequence[Entry], jobs: int = 2, limit_s: float = 300.0, config: str = ""
) -> Iterator[int]:
    """Diagnose entries of the manifest; yield the exit code of each as it ends.

    `out/diagnoses/NAME` takes the report, `out/runs/NAME.json` the record: seconds, exit code,
    message, hash of the report. Loading torch takes longer than many a diagnosis, hence few
    processes for many; one that dies ends the whole run, and the next goes on from there.
    """
    for name in ("runs", "diagnoses", "configs"):
        (out / name).mkdir(exist_ok=True)
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(jobs, context) as pool:
        runs = [pool.submit(run_one, out, entry, limit_s, config) for entry in entries]
        for done in as_completed(runs):
            yield done.result()


def run(arguments: Sequence[str], limit_s: float) -> dict[str, Any]:
    """Run a command of the program in this process; every failure of it is a result."""
    from tofcorr.cli.main import group

    def stop(*_: object) -> None:
        raise TimeoutError(f"no answer within {limit_s:g} s")

    start, code, message = time.perf_counter(), 0, ""
    signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, limit_s)
    try:
        with contextlib.redirect_stdout(sys.stderr):
            group(list(arguments), standalone_mode=False)
    except SystemExit as ended:
        code = int(ended.code or 0)
    except Exception as error:  # noqa: BLE001 - see above
        code, message = 1, "".join(traceback.format_exception(error))[-4000:]
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
    return {"seconds": time.perf_counter() - start, "code": code, "message": message}


def run_one(out: Path, entry: Entry, limit_s: float = 300.0, config: str = "") -> int:
    """Diagnose one recording; return the exit code."""
    name, report = entry["id"], out / "diagnoses" / entry["id"]
    config += f"\n{entry.get('config', '')}\n"
    if entry["exclude"]:
        config += f"leave_out: {json.dumps(entry['exclude'])}\n"
    file = out / "configs" / f"{name}.yaml"
    file.write_text(config)
    arguments = ["diagnose", "--recording", str(out / "recordings" / name), "--out", str(report)]
    arguments += ["--config", str(file)] if config.strip() else []
    arguments += ["--sim", str(out / "recordings" / entry["sim"])] if entry.get("sim") else []
    record = run(arguments, limit_s)
    if entry.get("held_out") and (report / "sensor.yaml").exists():
        record["degrade"] = _degrade(out, entry, report / "sensor.yaml", limit_s)
    written = report / "diagnosis.json"
    if record["code"] == 0 and not written.exists():
        record |= {"code": 1, "message": "exit code 0 but no diagnosis.json"}
    record["report_sha256"] = digest(written.read_bytes()) if written.exists() else None
    part = out / "runs" / f"{name}.part"
    part.write_text(json.dumps(record))
    part.rename(out / "runs" / f"{name}.json")
    return record["code"]


def _degrade(out: Path, entry: Entry, sensor: Path, limit_s: float) -> dict[str, Any]:
    """Degrade ideal frames by the camera found, and return what came of the last.

    `degraded` are of another session, as it would measure them; `expected` the same and `own` those
    of the recording itself, without noise and lost pixels.
    """
    quiet = out / "configs" / f"{entry['id']}.sensor.yaml"
    found = yaml.safe_load(sensor.read_text())
    quiet.write_text(yaml.safe_dump(found | {"noise": None, "dropouts": None}))
    record: dict[str, Any] = {}
    for kind, frames, camera in (
        ("own", entry["id"], quiet),
        ("expected", entry["held_out"], quiet),
        ("degraded", entry["held_out"], sensor),
    ):
        ideal, to = out / "ideal" / entry["id"], out / kind / entry["id"]
        for folder in (ideal, to):  # of a run that was interrupted
            shutil.rmtree(folder, ignore_errors=True)
            folder.parent.mkdir(exist_ok=True)
        recalibrated(out / "recordings" / frames, found["tool_from_camera"], ideal)
        told = ["--sensor", str(camera), "--recording", str(ideal), "--out", str(to)]
        record = run(["degrade", *told], limit_s)
    return record


def recalibrated(frames: Path, tool_from_camera: list[list[float]], out: Path) -> None:
    """Write ideal frames of planes as seen from another place of the camera on the tool.

    A sensor's errors and its hand-eye transform are found together: a shift along the ray and a
    constant, or a turn and a principal point, hardly differ in the data. So whoever degrades frames
    recalibrates the simulator first, as the report says.
    """
    shutil.copytree(frames, out)
    data = read(frames)
    poses = data.world_from_tool @ np.array(tool_from_camera)
    toward = np.einsum("nij,hwj->nhwi", poses[:, :3, :3], data.rays)
    height = (data.normal * poses[:, :3, 3]).sum(-1) + data.offset
    radial = -height[:, None, None] / np.einsum("ni,nhwi->nhw", data.normal, toward)
    seen = np.isfinite(data.depth) & (data.depth > 0)
    depth = np.where(seen, radial * data.depth_per_range, np.nan)
    np.save(out / "depth.npy", depth.astype(np.float32))
    header = yaml.safe_load((frames / "recording.yaml").read_text())
    header["tool_from_camera"] = tool_from_camera
    (out / "recording.yaml").write_text(yaml.safe_dump(header))
