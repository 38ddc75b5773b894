"""Rules that no linter knows."""

import ast
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from import_graph import circles, import_graph, reached_from

from tofcorr.cli.main import COMMANDS
from tofcorr.importing.registry import IMPORTERS

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


@pytest.mark.parametrize("command", ["", *COMMANDS, *(f"import {name}" for name in IMPORTERS)])
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


CONTRACTS = {
    contract["name"]: contract
    for contract in tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"][
        "importlinter"
    ]["contracts"]
}
GRAPH = import_graph()


def _layer(module: str) -> str:
    """Return the room of a module: the first name below the package."""
    return module.split(".")[1]


def test_no_files_import_each_other_in_a_circle() -> None:
    assert circles(GRAPH) == []


def test_no_import_runs_to_a_higher_layer() -> None:
    layers = [layer.split(" | ") for layer in CONTRACTS["Layers"]["layers"]]
    rank = {name: number for number, names in enumerate(layers) for name in names}
    upward = [
        f"{module} imports {other}"
        for module, imported in GRAPH.items()
        for other in imported
        if "." in module and (other == "tofcorr" or not _may_import(module, other, rank))
    ]
    assert upward == []


def _may_import(module: str, other: str, rank: dict[str, int]) -> bool:
    own, its = _layer(module), _layer(other)
    return own == its or rank[own] < rank[its]


@pytest.mark.parametrize("name", [n for n, c in CONTRACTS.items() if c["type"] == "forbidden"])
def test_what_a_room_may_not_reach_it_does_not_reach(name: str) -> None:
    rooms = tuple(f"{room}." for room in CONTRACTS[name]["source_modules"])
    forbidden = tuple(f"{room}." for room in CONTRACTS[name]["forbidden_modules"])
    reached = {
        f"{module} reaches {other}"
        for module in GRAPH
        if f"{module}.".startswith(rooms)
        for other in reached_from(module, GRAPH)
        if f"{other}.".startswith(forbidden)
    }
    assert reached == set()


def test_late_imports_and_imports_by_name_are_seen(tmp_path: Path) -> None:
    files = {
        "__init__.py": "",
        "a.py": "def f():\n    from pkg import b",
        "b.py": "from importlib import import_module\nimport_module(f'pkg.{\"c\" + str()}')\n'c'",
        "c.py": "from pkg.a import f",
        "d.py": "if TYPE_CHECKING:\n    from pkg.e import x",
        "e.py": "import pkg.d",
    }
    (tmp_path / "pkg").mkdir()
    for name, text in files.items():
        (tmp_path / "pkg" / name).write_text(text, encoding="utf-8")
    graph = import_graph(tmp_path / "pkg")
    assert circles(graph) == [["pkg.a", "pkg.b", "pkg.c"]]
    assert graph["pkg.e"] == {"pkg.d"}


def test_no_source_file_is_long_without_a_reason() -> None:
    """A file above 250 lines says why, in a line that begins with `# Long:`."""
    long = {}
    for path in (ROOT / "tofcorr").rglob("*.py"):
        lines = path.read_text(encoding="utf-8").splitlines()
        if len(lines) > 250 and not any(line.startswith("# Long: ") for line in lines):
            long[path.relative_to(ROOT).as_posix()] = len(lines)
    assert long == {}
