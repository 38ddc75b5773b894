"""A copy of the package with more files and more lines, as contributors would add them."""

import json
import os
import shutil
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import pytest
import simulated_walls
from diagnosed_recordings import PLAIN
from docs.pages import ADDING, blocks
from running import printed

import tofcorr
from tofcorr.options import dump_yaml

# The text in each registry in front of which the line goes.
END_OF_LIST = {
    "error_terms": ")\n\n\ndef _class",
    "simulation": ")\n\n\ndef _classes",
    "importing": '}\n"""The line of each',
    "correction": ")\n\nFORMATS",
    "plausibility": ')\n"""Checks that look at values',
}

RUN_PIECES = """
import contextlib, io, json, os, sys, traceback
from pathlib import Path

outcomes = {}
for name, code in json.load(sys.stdin).items():
    Path(name).mkdir()
    printed, error = io.StringIO(), ""
    with contextlib.chdir(name), contextlib.redirect_stdout(printed):
        try:
            exec(compile(code, name, "exec"), {"__name__": name})
        except BaseException:
            error = traceback.format_exc()
    outcomes[name] = printed.getvalue(), error
print(json.dumps(outcomes))
"""

HERE = Path(__file__).parent
PIECES = {path.stem: path.read_text(encoding="utf-8") for path in (HERE / "pieces").glob("*.py")}
"""Programs that use what was added."""

EFFECT_LINE = '# tofcorr/simulation/effects/registry.py\n    "stripes:StripesEffect",'
CONFIGURATIONS = {
    "wall": simulated_walls.wall_options(1).to_mapping(),
    "simulator": PLAIN | {"effects": [{"name": "stripes", "height_m": 0.006}]},
    "diagnose": {"catalogue": ["stripes", "incidence_angle"], "bootstraps": 19}
    | {"simulate_anew": False, "page": False},
}
"""What the programs read."""


@dataclass(frozen=True)
class Extension:
    """The extended package, after every piece of code was run in it.

    Attributes:
        root: The folder that holds the copied package, and a folder for each piece.
        outcomes: What each piece printed, and the traceback of its error, if any.
    """

    root: Path
    outcomes: Mapping[str, tuple[str, str]]

    def printed_by(self, piece: str) -> str:
        """Return what a piece printed; it must have run without an error."""
        printed, error = self.outcomes[piece]
        assert not error, error
        return printed

    def folder_of(self, piece: str) -> Path:
        """Return the folder that a piece worked in; it must have run without an error."""
        self.printed_by(piece)
        return self.root / piece


def add(package: Path, file: str, registration: str) -> None:
    """Add a file and a line of a registry, each named by its first line, to a copied package."""
    new, registry = (
        text.splitlines()[0].removeprefix("# tofcorr/") for text in (file, registration)
    )
    assert not (package / new).exists()
    (package / new).write_text(file, encoding="utf-8")
    before, found = END_OF_LIST[registry.partition("/")[0]], (package / registry).read_text("utf-8")
    assert found.count(before) == 1
    _, line = registration.splitlines()
    (package / registry).write_text(found.replace(before, f"{line}\n{before}"), encoding="utf-8")


@pytest.fixture(scope="session")
def extension(tmp_path_factory: pytest.TempPathFactory) -> Extension:
    """The copy, and what ran in it: one process for all, which loads torch once."""
    root, pieces = tmp_path_factory.mktemp("extended"), dict(PIECES)
    # Compiled files too: copying keeps their times, so they hold. Another worker may be writing
    # one, which has such a name until it is whole.
    unfinished = shutil.ignore_patterns("*.pyc.*")
    shutil.copytree(Path(tofcorr.__file__).parent, root / "tofcorr", ignore=unfinished)
    add(root / "tofcorr", (HERE / "stripes.py").read_text(encoding="utf-8"), EFFECT_LINE)
    for name, values in CONFIGURATIONS.items():
        (root / f"{name}.yaml").write_text(dump_yaml(values), encoding="utf-8")
    for page in ADDING:
        shown = [block.text for block in blocks(page) if block.language == "python"]
        own = [text for text in shown if text.startswith("# tofcorr/")]
        add(root / "tofcorr", *own)
        pieces[page.stem] = "\n".join(text for text in shown if text not in own)
        assert pieces[page.stem], "the page shows no use"
    how = {"cwd": root, "env": os.environ | {"PYTHONPATH": str(root)}}
    outcomes = printed(sys.executable, "-c", RUN_PIECES, input=json.dumps(pieces), **how)
    return Extension(root, json.loads(outcomes))
