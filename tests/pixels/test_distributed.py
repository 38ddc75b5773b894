"""Processes started by `torchrun` fit what one process fits."""

import os
import socket
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from simulated_walls import simulated_wall

from tofcorr.options import resolve_options
from tofcorr.training.calibration import TrainingOptions
from tofcorr.training.run import train

TRAIN = str(Path(__file__).resolve().parents[2] / "scripts" / "train.py")
ONE_THREAD = {"OMP_NUM_THREADS": "1"}


def start_both(script: tuple[str, ...]) -> None:
    """Start two processes with the variables that `torchrun` sets, and wait for them."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    group = {"WORLD_SIZE": "2", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port)}
    started = [
        subprocess.Popen(
            [sys.executable, *script],
            env=os.environ | ONE_THREAD | group | {"RANK": rank, "LOCAL_RANK": rank},
            stderr=subprocess.PIPE,
            text=True,
        )
        for rank in ("0", "1")
    ]
    told = [process.communicate()[1] for process in started]
    assert [process.returncode for process in started] == [0, 0], told


def numbers_in(value: Any) -> list[float]:
    """Return all numbers in nested mappings and lists, in their order."""
    if isinstance(value, dict):
        value = list(value.values())
    if isinstance(value, list):
        return [number for part in value for number in numbers_in(part)]
    return [float(value)] if isinstance(value, int | float) else []


def test_two_processes_fit_what_one_fits(tmp_path: Path) -> None:
    recording = simulated_wall(tmp_path / "recording").first.path
    quick = resolve_options(TrainingOptions, "ea", ("advice=0", "figures=false"))
    train(recording, quick, out=tmp_path / "one")
    files = ("--recording", str(recording), "--out", str(tmp_path / "two"), "--no-figures")
    start_both((TRAIN, "--config", "ea", "--set", "advice=0", *files))
    for file, part in (
        ("report.json", "hand_eye"),
        ("report.json", "error_mm"),
        ("calibration.yaml", "coefficients"),
    ):
        texts = ((tmp_path / name / file).read_text() for name in ("one", "two"))
        one, two = (numbers_in(yaml.safe_load(text)[part]) for text in texts)
        np.testing.assert_allclose(two, one, rtol=1e-9)
