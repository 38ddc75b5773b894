"""Shared by all tests: real data when it is there, a seeded generator, and an installed wheel."""

import os
import shutil
import site
import sys
import venv
from collections.abc import Iterator
from pathlib import Path

import pytest
import shape_checks  # noqa: F401 - it puts itself in the place of a decorator.
import torch
from hypothesis import settings
from running import Program, Said, printed_alone

from tofcorr.cli.main import main
from tofcorr.progress import LOG

ROOT = Path(__file__).resolve().parents[1]
PACKED = ("tofcorr", "configs", "pyproject.toml", "setup.py", "MANIFEST.in", "README.md")
PACKED += ("LICENSE", "CHANGELOG.md", "CITATION.cff")
"""What a source distribution is built from."""

# The tests' tensors are small and their workers many: threads would only wait for each other.
torch.set_num_threads(1)

# The same examples everywhere, and no deadline: machines differ, laws do not.
settings.register_profile("tofcorr", derandomize=True, deadline=None)
settings.load_profile("tofcorr")


@pytest.fixture
def log_lines() -> Iterator[None]:
    """What `--verbose` sets is gone after a test."""
    level, handlers = LOG.level, list(LOG.handlers)
    yield
    LOG.setLevel(level)
    LOG.handlers[:] = handlers


@pytest.fixture
def program(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], log_lines: None
) -> Program:
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


@pytest.fixture(scope="session")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build a source distribution from a copy of the repository, and the wheel from that."""
    source = tmp_path_factory.mktemp("source")
    for name in PACKED:
        if (ROOT / name).is_dir():
            ignored = shutil.ignore_patterns("__pycache__", "*.egg-info")
            shutil.copytree(ROOT / name, source / name, ignore=ignored)
        else:
            shutil.copy(ROOT / name, source)
    printed_alone(sys.executable, source, "-m", "build", "--no-isolation", "--outdir", "dist")
    return next((source / "dist").glob("*.whl"))


@pytest.fixture(scope="session")
def python_with_wheel(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the Python of a new environment that holds the wheel.

    The packages that tofcorr needs come from the environment of the tests, by a path put behind
    the new environment's own. That path brings no tofcorr: an editable install is a `.pth` file,
    which Python reads in its own site-packages only.
    """
    folder = tmp_path_factory.mktemp("environment")
    venv.create(folder, with_pip=False, symlinks=os.name != "nt")
    new = next(path for path in folder.rglob("python*") if path.stem == "python")
    pip = ("-m", "pip", "--python", str(new), "install", "--no-deps", "--no-index", "--no-compile")
    printed_alone(sys.executable, folder, *pip, str(wheel))
    packages = next(folder.rglob("site-packages"))
    (packages / "packages_of_the_tests.pth").write_text("\n".join(site.getsitepackages()))
    return new
