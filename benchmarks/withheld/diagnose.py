"""Run the program under test on every recording of a manifest; it sees the recordings alone.

An entry with `sim` names the simulator's recording, one with `held_out` ideal frames to be degraded
by the camera that the diagnosis found.
"""

import json
import os
import shutil
import subprocess
import sys
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from benchmarks.withheld.pairs.recalibrated import recalibrated
from benchmarks.withheld.sealing import digest

ENVIRONMENT = {
    "OMP_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    # Memory once taken is kept: getting it anew from the system takes longer than some steps.
    "MALLOC_MMAP_THRESHOLD_": "2147483648",
    "MALLOC_TRIM_THRESHOLD_": "8589934592",
}

COMMAND = [sys.executable, "-m", "benchmarks.withheld.worker"]


@dataclass(frozen=True)
class Plan:
    """How to run: processes, seconds for each, configuration, its key that drops effects."""

    workers: int = 2
    limit_s: float = 300.0
    config: str = ""
    exclude_key: str = "leave_out"


class Worker:
    """One `benchmarks.withheld.worker` process, started when needed and again after it died."""

    def __init__(self, log: Path) -> None:
        self._log = log
        self._process: subprocess.Popen[str] | None = None

    def ask(self, arguments: list[str], limit_s: float) -> dict[str, Any]:
        """Diagnose; a crash or a run past the limit is an answer as well."""
        process = self._running()
        assert process.stdin is not None
        assert process.stdout is not None
        late = threading.Timer(limit_s, process.kill)
        late.start()
        try:
            process.stdin.write(json.dumps({"arguments": arguments}) + "\n")
            process.stdin.flush()
            line = process.stdout.readline()
        except BrokenPipeError:
            line = ""
        finally:
            late.cancel()
        if line:
            return json.loads(line)
        code = process.wait()
        self.close()
        return {
            "seconds": limit_s,
            "code": code or 1,
            "message": f"no answer: the process ended with {code}",
        }

    def close(self) -> None:
        """End the process, if one runs."""
        process, self._process = self._process, None
        if process is None:
            return
        for pipe in (process.stdin, process.stdout):
            if pipe is not None:
                with suppress(BrokenPipeError):
                    pipe.close()
        process.wait()

    def _running(self) -> subprocess.Popen[str]:
        if self._process is None:
            environment = os.environ | ENVIRONMENT
            with self._log.open("a") as log:
                self._process = subprocess.Popen(
                    COMMAND,
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                    stderr=log,
                    text=True,
                    env=environment,
                )
        return self._process


def waiting(out: Path) -> list[dict[str, Any]]:
    """Entries of the manifest that have no run record yet."""
    entries = json.loads((out / "manifest.json").read_text())["recordings"]
    return [entry for entry in entries if not (out / "runs" / f"{entry['id']}.json").exists()]


def diagnose(out: Path, entries: Sequence[dict[str, Any]], plan: Plan) -> Iterator[tuple[str, int]]:
    """Diagnose entries of the manifest; yield each recording's name and exit code as it ends.

    `out/diagnoses/NAME` takes the report, `out/runs/NAME.json` the record: seconds, exit code,
    message, hash of the report.
    """
    (out / "runs").mkdir(exist_ok=True)
    (out / "diagnoses").mkdir(exist_ok=True)
    own = threading.local()
    workers: list[Worker] = []

    def run(entry: dict[str, Any]) -> tuple[str, int]:
        if not hasattr(own, "worker"):
            own.worker = Worker(out / "diagnose.log")
            workers.append(own.worker)
        return entry["id"], _run_one(out, entry, plan, own.worker)

    with ThreadPoolExecutor(plan.workers) as pool:
        try:
            for done in as_completed([pool.submit(run, entry) for entry in entries]):
                yield done.result()
        finally:
            pool.shutdown(wait=True, cancel_futures=True)
            for worker in workers:
                worker.close()


def _run_one(out: Path, entry: dict[str, Any], plan: Plan, worker: Worker) -> int:
    name = entry["id"]
    report = out / "diagnoses" / name
    arguments = ["diagnose", "--recording", str(out / "recordings" / name), "--out", str(report)]
    config = plan.config + entry.get("config", "")
    if entry["exclude"]:
        config += f"\n{plan.exclude_key}: {json.dumps(entry['exclude'])}\n"
    if config.strip():
        (out / "configs").mkdir(exist_ok=True)
        file = out / "configs" / f"{name}.yaml"
        file.write_text(config)
        arguments += ["--config", str(file)]
    if entry.get("sim"):
        arguments += ["--sim", str(out / "recordings" / entry["sim"])]
    record = worker.ask(arguments, plan.limit_s)
    if entry.get("held_out") and (report / "sensor.yaml").exists():
        record["degrade"] = worker.ask(_degrade(out, entry, report), plan.limit_s)
        if record["degrade"]["code"] == 0:
            for arguments in _degrade_without_noise(out, entry, report):
                worker.ask(arguments, plan.limit_s)
    written = report / "diagnosis.json"
    if record["code"] == 0 and not written.exists():
        record |= {"code": 1, "message": "exit code 0 but no diagnosis.json"}
    record["report_sha256"] = digest(written.read_bytes()) if written.exists() else None
    temporary = out / "runs" / f"{name}.part"
    temporary.write_text(json.dumps(record))
    temporary.rename(out / "runs" / f"{name}.json")
    return record["code"]


def _degrade(out: Path, entry: dict[str, Any], report: Path) -> list[str]:
    """Arguments that turn the ideal frames of an entry into what the camera found would measure."""
    sensor = report / "sensor.yaml"
    ideal = _seen_by(sensor, out / "recordings" / entry["held_out"], out / "recalibrated", entry)
    return _degrade_by(sensor, ideal, out / "degraded" / entry["id"])


def _seen_by(sensor: Path, frames: Path, folder: Path, entry: dict[str, Any]) -> Path:
    """Write the ideal frames of a recording, seen from where the sensor has the camera."""
    ideal = folder / entry["id"]
    folder.mkdir(exist_ok=True)
    shutil.rmtree(ideal, ignore_errors=True)  # Of a run that was interrupted.
    return recalibrated(frames, sensor, ideal)


def _degrade_without_noise(out: Path, entry: dict[str, Any], report: Path) -> Iterator[list[str]]:
    """The same for a camera that neither has noise nor loses pixels: what it is expected to see.

    First of the other session, then at the poses of the recording itself.
    """
    name = entry["id"]
    sensor = out / "quiet" / f"{name}.yaml"
    sensor.parent.mkdir(exist_ok=True)
    found = yaml.safe_load((report / "sensor.yaml").read_text())
    sensor.write_text(yaml.safe_dump(found | {"noise": None, "dropouts": None}))
    yield _degrade_by(sensor, out / "recalibrated" / name, out / "expected" / name)
    own = _seen_by(sensor, out / "recordings" / name, out / "own_ideal", entry)
    yield _degrade_by(sensor, own, out / "own" / name)


def _degrade_by(sensor: Path, ideal: Path, to: Path) -> list[str]:
    to.parent.mkdir(exist_ok=True)
    shutil.rmtree(to, ignore_errors=True)
    return ["degrade", "--sensor", str(sensor), "--recording", str(ideal), "--out", str(to)]
