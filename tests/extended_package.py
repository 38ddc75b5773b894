"""A copy of the package with one more file and one more line, as a contributor would add them."""

import os
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import tofcorr

PACKAGE = Path(tofcorr.__file__).parent


@dataclass(frozen=True)
class ExtendedPackage:
    """A copy of the package in a folder of its own.

    Attributes:
        root: The folder that holds the copied `tofcorr`.
    """

    root: Path

    def run(self, code: str) -> str:
        """Run Python code that imports the copy; return what it printed."""
        done = subprocess.run(
            [sys.executable, "-c", code],
            capture_output=True,
            text=True,
            check=False,
            cwd=self.root,
            env=os.environ | {"PYTHONPATH": str(self.root)},
        )
        assert done.returncode == 0, done.stderr
        return done.stdout


def extend(
    folder: Path, new_file: tuple[str, str], registry: str, before: str, line: str
) -> ExtendedPackage:
    """Copy the package, add one file, and insert one line into one registry.

    Args:
        folder: Where the copy goes.
        new_file: Path inside `tofcorr`, and its text.
        registry: Path of the registry inside `tofcorr`.
        before: The text in front of which the line goes; it stands once in the registry.
        line: The line that registers the new thing.
    """
    shutil.copytree(PACKAGE, folder / "tofcorr", ignore=shutil.ignore_patterns("__pycache__"))
    path, text = new_file
    assert not (folder / "tofcorr" / path).exists()
    (folder / "tofcorr" / path).write_text(text, encoding="utf-8")
    registered = folder / "tofcorr" / registry
    found = registered.read_text(encoding="utf-8")
    assert found.count(before) == 1
    assert "\n" not in line
    registered.write_text(found.replace(before, f"{line}\n{before}"), encoding="utf-8")
    return ExtendedPackage(folder)
