"""Processes started by `torchrun` fit what one process fits."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from simulated_walls import simulated_wall

from tofcorr.training.run import train

ROOT = Path(__file__).resolve().parents[2]


def train_in_two_processes(recording: Path, out: Path) -> dict[str, Any]:
    """Run `scripts/train.py` under `torchrun`; return its report."""
    launcher = ("-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2")
    script = str(ROOT / "scripts" / "train.py")
    arguments = ("--config", "ea", "--recording", str(recording), "--out", str(out))
    done = subprocess.run(
        [sys.executable, *launcher, script, *arguments],
        capture_output=True,
        text=True,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return json.loads((out / "report.json").read_text())


def numbers_in(value: Any) -> list[float]:
    """Return all numbers in nested mappings and lists, in their order."""
    if isinstance(value, dict):
        value = list(value.values())
    if isinstance(value, list):
        return [number for part in value for number in numbers_in(part)]
    return [float(value)] if isinstance(value, int | float) else []


def test_two_processes_fit_what_one_fits(tmp_path: Path) -> None:
    recording = simulated_wall(tmp_path / "recording").first.path
    train(recording, "ea", out=tmp_path / "one")
    one = json.loads((tmp_path / "one" / "report.json").read_text())
    two = train_in_two_processes(recording, tmp_path / "two")
    for part in ("hand_eye", "error_mm"):
        np.testing.assert_allclose(numbers_in(two[part]), numbers_in(one[part]), rtol=1e-9)
    calibrations = [
        yaml.safe_load((tmp_path / name / "calibration.yaml").read_text())
        for name in ("one", "two")
    ]
    expected, found = (numbers_in(each["coefficients"]) for each in calibrations)
    np.testing.assert_allclose(found, expected, rtol=1e-9)
