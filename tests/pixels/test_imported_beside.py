"""Modules are imported beside other work, and are all there when it ends."""

import sys
from pathlib import Path

import pytest

from tofcorr.pixels.imported_beside import imported_beside


@pytest.fixture
def slow_module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """A module that takes a moment to import."""
    (tmp_path / "slow_to_import.py").write_text("import time\ntime.sleep(0.05)\ndone = True\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr("tofcorr.pixels.imported_beside.threads_at_once", lambda: 2)
    monkeypatch.delitem(sys.modules, "slow_to_import", raising=False)
    return "slow_to_import"


def test_the_block_does_not_wait_and_its_end_does(slow_module: str) -> None:
    turn = sys.getswitchinterval()
    with imported_beside(["no_such_module", slow_module], True):
        assert not hasattr(sys.modules.get(slow_module), "done")
    assert sys.modules[slow_module].done
    assert sys.getswitchinterval() == turn


def test_nothing_is_imported_where_it_is_not_allowed(slow_module: str) -> None:
    with imported_beside([slow_module], False):
        pass
    assert slow_module not in sys.modules


def test_nothing_is_imported_beside_where_there_is_one_core(
    slow_module: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tofcorr.pixels.imported_beside.threads_at_once", lambda: 1)
    with imported_beside([slow_module], True):
        pass
    assert slow_module not in sys.modules
