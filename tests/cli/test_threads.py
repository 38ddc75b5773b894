"""Threads sleep while they wait and are as many as the cores, unless the user says otherwise."""

import os
import sys
from pathlib import Path

import pytest
from running import printed

from tofcorr.cli.main import set_up_threads


@pytest.mark.parametrize(
    ("name", "value"), [("OMP_WAIT_POLICY", "active"), ("GOMP_SPINCOUNT", "7")]
)
def test_what_the_user_says_stands(name: str, value: str, tmp_path: Path) -> None:
    (tmp_path / "cpu.max").write_text("100000 100000")
    chosen = {name: value, "OMP_NUM_THREADS": "3", "OPENBLAS_NUM_THREADS": "2"}
    kept = dict(chosen)
    set_up_threads(chosen, tmp_path / "cpu.max")
    assert chosen == kept


@pytest.mark.parametrize(
    ("text", "number"),
    [("40000 100000\n", "1"), ("290000 100000", "2"), ("6400000 100000", None), ("max 1", None)],
)
def test_no_more_threads_than_the_container_may_run(
    text: str, number: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "cpu_count", lambda: 8)
    (tmp_path / "cpu.max").write_text(text)
    environment: dict[str, str] = {}
    set_up_threads(environment, tmp_path / "cpu.max")
    assert environment.get("OMP_NUM_THREADS") == number
    set_up_threads(environment, tmp_path / "none")


def test_the_program_sets_them_before_torch_is_loaded() -> None:
    code = (
        "import os, sys; import tofcorr.cli.main as m; assert 'torch' not in sys.modules; "
        "m.group = lambda **_: print(os.environ['OMP_WAIT_POLICY'], "
        "os.environ['OPENBLAS_NUM_THREADS'], 'torch' in sys.modules); m.main()"
    )
    names = "OMP_WAIT_POLICY", "GOMP_SPINCOUNT", "OPENBLAS_NUM_THREADS"
    clean = {k: v for k, v in os.environ.items() if k not in names}
    said = printed(sys.executable, "-c", code, env=clean)
    assert said.split() == ["passive", "1", "False"]
