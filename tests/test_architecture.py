"""Rules that no linter knows."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

from tofcorr.cli.main import COMMANDS

ROOT = Path(__file__).resolve().parents[1]
CONFINED = {
    "cv2": {"tofcorr/importing"},
    "torch.utils.tensorboard": {
        "tofcorr/training/monitor.py",
        "tofcorr/comparison/monitor.py",
        "tofcorr/diagnosis/report/monitor.py",
    },
    "yaml": {"tofcorr/options", "tofcorr/data", "tofcorr/importing"},
}


def _imports(path: Path) -> set[str]:
    tree = ast.parse(path.read_text(encoding="utf-8"))
    names: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        if isinstance(node, ast.ImportFrom) and node.module:
            names |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
    return names


@pytest.mark.parametrize("library", CONFINED)
def test_library_is_imported_only_where_it_may_be(library: str) -> None:
    offenders = [
        path.relative_to(ROOT).as_posix()
        for path in (ROOT / "tofcorr").rglob("*.py")
        if any(name == library or name.startswith(f"{library}.") for name in _imports(path))
        and not any(
            path.relative_to(ROOT).as_posix().startswith(home) for home in CONFINED[library]
        )
    ]
    assert offenders == []


@pytest.mark.parametrize("command", ["", *COMMANDS])
def test_help_imports_neither_torch_nor_kornia(command: str) -> None:
    code = (
        "import sys\n"
        f"sys.argv = ['tofcorr', *{command.split()!r}, '--help']\n"
        "from tofcorr.cli.main import main\n"
        "try:\n    main()\n"
        "except SystemExit as done:\n    assert not done.code, done.code\n"
        "heavy = {'torch', 'kornia', 'cv2', 'scipy'} & set(sys.modules)\n"
        "assert not heavy, heavy\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False, cwd=ROOT
    )
    assert done.returncode == 0, done.stderr
    assert "Usage: tofcorr" in done.stdout


def test_importing_the_package_leaves_torch_unloaded() -> None:
    code = "import sys, tofcorr; assert 'torch' not in sys.modules; tofcorr.CalibrationDataError"
    subprocess.run([sys.executable, "-c", code], check=True, cwd=ROOT)


def test_no_source_file_is_long() -> None:
    long = {
        path.relative_to(ROOT).as_posix(): lines
        for path in (ROOT / "tofcorr").rglob("*.py")
        if (lines := len(path.read_text(encoding="utf-8").splitlines())) > 350
    }
    assert long == {}
