"""Rules that no linter knows."""

import sys
from pathlib import Path

import grimp
from import_graph import imported
from running import printed

from tofcorr.cli.main import COMMANDS
from tofcorr.importing.registry import IMPORTERS

ROOT = Path(__file__).resolve().parents[1]


def test_yaml_is_imported_only_where_it_may_be() -> None:
    """Ruff knows where OpenCV and TensorBoard may be."""
    files = {path.relative_to(ROOT).as_posix(): path for path in (ROOT / "tofcorr").rglob("*.py")}
    users = [name for name, path in files.items() if "yaml" in imported(path.read_text("utf-8"))]
    places = ("tofcorr/options.py", "tofcorr/data/", "tofcorr/importing/")
    assert users
    assert [name for name in users if not name.startswith(places)] == []


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
    assert printed(sys.executable, "-c", code, cwd=ROOT).count("Usage: tofcorr") == len(asked)


def test_no_files_import_each_other_in_a_circle() -> None:
    """Imports inside functions count; those under `if TYPE_CHECKING` do not run."""
    graph = grimp.build_graph("tofcorr", exclude_type_checking_imports=True, cache_dir=None)
    circles = {
        (module, other)
        for module in graph.modules
        for other in graph.find_modules_directly_imported_by(module)
        if module in graph.find_upstream_modules(other)
    }
    assert circles == set()


def test_no_source_file_is_long_without_a_reason() -> None:
    """A file above 600 lines says why, in a line that begins with `# Long:`."""
    long = {}
    for path in (ROOT / "tofcorr").rglob("*.py"):
        lines = path.read_text(encoding="utf-8").splitlines()
        if len(lines) > 600 and not any(line.startswith("# Long: ") for line in lines):
            long[path.relative_to(ROOT).as_posix()] = len(lines)
    assert long == {}
