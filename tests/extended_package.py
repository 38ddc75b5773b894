"""A copy of the package with more files and more lines, as contributors would add them."""

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import tofcorr

PACKAGE = Path(tofcorr.__file__).parent

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


@dataclass(frozen=True)
class Addition:
    """One more thing of a kind that the package keeps a registry of.

    Attributes:
        path: The new file, inside `tofcorr`.
        text: What it holds.
        registry: Path of the registry inside `tofcorr`.
        before: The text in front of which the line goes; it stands once in the registry.
        line: The line that registers the new thing.
    """

    path: str
    text: str
    registry: str
    before: str
    line: str


@dataclass(frozen=True)
class ExtendedPackage:
    """A copy of the package in a folder of its own.

    Attributes:
        root: The folder that holds the copied `tofcorr`.
    """

    root: Path

    @classmethod
    def copy(cls, root: Path) -> "ExtendedPackage":
        """Copy the package, compiled files included: copying keeps their times, so they hold."""
        # Another worker may be writing a compiled file, which has such a name until it is whole.
        unfinished = shutil.ignore_patterns("*.pyc.*")
        shutil.copytree(PACKAGE, root / "tofcorr", ignore=unfinished)
        return cls(root)

    def add(self, addition: Addition) -> None:
        """Add one file, and insert one line into one registry."""
        package = self.root / "tofcorr"
        assert not (package / addition.path).exists()
        (package / addition.path).write_text(addition.text, encoding="utf-8")
        registered = package / addition.registry
        found = registered.read_text(encoding="utf-8")
        assert found.count(addition.before) == 1
        assert "\n" not in addition.line
        lines = f"{addition.line}\n{addition.before}"
        registered.write_text(found.replace(addition.before, lines), encoding="utf-8")

    def run(self, pieces: Mapping[str, str]) -> dict[str, tuple[str, str]]:
        """Run pieces of Python code by name, one after another, in one process that has the copy.

        Each has names of its own, and works in the folder `root/NAME`.

        Returns:
            For each piece what it printed, and the traceback of its error; empty if none.
        """
        done = subprocess.run(
            [sys.executable, "-c", RUN_PIECES],
            input=json.dumps(dict(pieces)),
            capture_output=True,
            text=True,
            check=False,
            cwd=self.root,
            env=os.environ | {"PYTHONPATH": str(self.root)},
        )
        assert done.returncode == 0, done.stderr
        return {
            name: (printed, error) for name, (printed, error) in json.loads(done.stdout).items()
        }
