"""Rules that no linter knows."""

import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from import_graph import Graph, circles, import_graph, imported, reached_from

from tofcorr.cli.main import COMMANDS
from tofcorr.importing.registry import IMPORTERS

ROOT = Path(__file__).resolve().parents[1]
CONFINED = {
    "cv2": {"tofcorr/importing", "tofcorr/correction/export/opencv.py"},
    "torch.utils.tensorboard": {"tofcorr/training/monitor.py"},
    "yaml": {"tofcorr/options.py", "tofcorr/data", "tofcorr/importing"},
}


@pytest.fixture(scope="module")
def imports() -> dict[str, set[str]]:
    """What each file of the package imports, by the file's path."""
    files = (ROOT / "tofcorr").rglob("*.py")
    return {path.relative_to(ROOT).as_posix(): imported(path.read_text("utf-8")) for path in files}


@pytest.mark.parametrize("library", CONFINED)
def test_library_is_imported_only_where_it_may_be(
    library: str, imports: dict[str, set[str]]
) -> None:
    users = {
        path
        for path, names in imports.items()
        if any(name == library or name.startswith(f"{library}.") for name in names)
    }
    assert users
    assert [path for path in users if not path.startswith(tuple(CONFINED[library]))] == []


def test_help_imports_neither_torch_nor_kornia() -> None:
    """Nor does `import tofcorr`. Asked in one process: once a library is loaded, it stays."""
    asked = ["", *COMMANDS, *(f"import {name}" for name in IMPORTERS)]
    code = f"""
import sys
import tofcorr
from tofcorr.cli.main import main
tofcorr.CalibrationDataError
for words in {asked!r}:
    sys.argv = ["tofcorr", *words.split(), "--help"]
    try:
        main()
    except SystemExit as done:
        assert not done.code, (words, done.code)
    heavy = {{"torch", "kornia", "cv2", "scipy"}} & set(sys.modules)
    assert not heavy, (words, heavy)
"""
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False, cwd=ROOT
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("Usage: tofcorr") == len(asked)


CONTRACTS = {
    contract["name"]: contract
    for contract in tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"][
        "importlinter"
    ]["contracts"]
}


@pytest.fixture(scope="module")
def graph() -> Graph:
    return import_graph()


def test_no_files_import_each_other_in_a_circle(graph: Graph) -> None:
    assert circles(graph) == []


def test_no_import_runs_to_a_higher_layer(graph: Graph) -> None:
    layers = [layer.split(" | ") for layer in CONTRACTS["Layers"]["layers"]]
    rank = {name: number for number, names in enumerate(layers) for name in names}
    upward = [
        f"{module} imports {other}"
        for module, others in graph.items()
        for other in others
        if "." in module and (other == "tofcorr" or not _may_import(module, other, rank))
    ]
    assert upward == []


def _may_import(module: str, other: str, rank: dict[str, int]) -> bool:
    """Return whether a room, the first name below the package, stands above the other."""
    own, its = module.split(".")[1], other.split(".")[1]
    return own == its or rank[own] < rank[its]


@pytest.mark.parametrize("name", [n for n, c in CONTRACTS.items() if c["type"] == "forbidden"])
def test_what_a_room_may_not_reach_it_does_not_reach(name: str, graph: Graph) -> None:
    rooms = tuple(f"{room}." for room in CONTRACTS[name]["source_modules"])
    forbidden = tuple(f"{room}." for room in CONTRACTS[name]["forbidden_modules"])
    reached = {
        f"{module} reaches {other}"
        for module in graph
        if f"{module}.".startswith(rooms)
        for other in reached_from(module, graph)
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
    """A file above 600 lines says why, in a line that begins with `# Long:`."""
    long = {}
    for path in (ROOT / "tofcorr").rglob("*.py"):
        lines = path.read_text(encoding="utf-8").splitlines()
        if len(lines) > 600 and not any(line.startswith("# Long: ") for line in lines):
            long[path.relative_to(ROOT).as_posix()] = len(lines)
    assert long == {}
