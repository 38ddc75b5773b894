"""Threads sleep while they wait and are as many as the cores, unless the user says otherwise."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tofcorr.cli import threads


def test_waiting_threads_sleep_unless_the_user_says_otherwise() -> None:
    environment: dict[str, str] = {}
    threads.set_up_threads(environment)
    assert environment["OMP_WAIT_POLICY"] == "passive"
    for name, value in (("OMP_WAIT_POLICY", "active"), ("GOMP_SPINCOUNT", "7")):
        chosen = {name: value, "OMP_NUM_THREADS": "3", "OPENBLAS_NUM_THREADS": "2"}
        kept = dict(chosen)
        threads.set_up_threads(chosen)
        assert chosen == kept


def test_products_of_numpy_run_in_one_thread() -> None:
    environment: dict[str, str] = {}
    threads.set_up_threads(environment)
    assert environment["OPENBLAS_NUM_THREADS"] == "1"


@pytest.mark.parametrize(
    ("text", "quota"), [("150000 100000\n", 1.5), ("max 100000\n", None), ("", None)]
)
def test_the_quota_of_a_container_is_read(text: str, quota: float | None, tmp_path: Path) -> None:
    (tmp_path / "cpu.max").write_text(text)
    assert threads.core_quota(tmp_path / "cpu.max") == quota
    assert threads.core_quota(tmp_path / "none") is None


@pytest.mark.parametrize(("quota", "number"), [(0.4, "1"), (2.9, "2"), (64.0, None), (None, None)])
def test_no_more_threads_than_the_container_may_run(
    quota: float | None, number: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(threads, "core_quota", lambda: quota)
    monkeypatch.setattr(threads, "_visible_cores", lambda: 8)
    environment: dict[str, str] = {}
    threads.set_up_threads(environment)
    assert environment.get("OMP_NUM_THREADS") == number


def test_the_program_sets_them_before_torch_is_loaded() -> None:
    code = (
        "import os, sys; import tofcorr.cli.main as m; assert 'torch' not in sys.modules; "
        "m.group = lambda **_: print(os.environ['OMP_WAIT_POLICY'], 'torch' in sys.modules); "
        "m.main()"
    )
    clean = {k: v for k, v in os.environ.items() if k not in ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT")}
    done = subprocess.run(
        [sys.executable, "-c", code], check=True, capture_output=True, text=True, env=clean
    )
    assert done.stdout.split() == ["passive", "False"]
