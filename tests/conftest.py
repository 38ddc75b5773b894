"""Shared by all tests: real data when it is there, and a seeded generator."""

import os
import sys
from pathlib import Path

import pytest
import shape_checks  # noqa: F401 - it puts itself in the place of a decorator.
import torch
from hypothesis import settings
from running import Program, Said

from tofcorr.cli.main import main

# The tests' tensors are small and their workers many: threads would only wait for each other.
torch.set_num_threads(1)

# The same examples everywhere, and no deadline: machines differ, laws do not.
settings.register_profile("tofcorr", derandomize=True, deadline=None)
settings.load_profile("tofcorr")


@pytest.fixture
def program(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Program:
    """The command line as a user has it: arguments in, exit code and what is printed out."""

    def run(*arguments: object) -> Said:
        monkeypatch.setattr(sys, "argv", ["tofcorr", *map(str, arguments)])
        code: object = 0
        try:
            main()
        except SystemExit as done:
            code = done.code
        printed = capsys.readouterr()
        assert code is None or isinstance(code, int)
        return Said(code or 0, printed.out, printed.err)

    return run


@pytest.fixture
def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


@pytest.fixture(scope="session")
def real_data() -> Path:
    folder = os.environ.get("TOFCORR_REAL_DATA")
    if not folder or not Path(folder).is_dir():
        pytest.skip("TOFCORR_REAL_DATA does not name the folder of real recordings")
    return Path(folder)
