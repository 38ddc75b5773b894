"""A page in a process of its own: `python run_page.py BLOCKS.json`; its blocks run in order.

Python blocks share their names, as the cells of a notebook do; shell blocks run in bash. What each
printed is written beside the blocks, up to one that failed.
"""

import io
import json
import subprocess
import sys
import traceback
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any


def main() -> None:
    """Run the blocks of the file in the current folder."""
    place = Path(sys.argv[1])
    names: dict[str, Any] = {"__name__": "page"}
    outcomes: list[dict[str, Any]] = []
    for block in json.loads(place.read_text(encoding="utf-8")):
        ok, said = _python(block, names) if block["language"] == "python" else _bash(block)
        outcomes.append({"line": block["line"], "ok": ok, "printed": said})
        if not ok:
            break
    place.with_suffix(".out.json").write_text(json.dumps(outcomes), encoding="utf-8")


def _python(block: dict[str, Any], names: dict[str, Any]) -> tuple[bool, str]:
    printed = io.StringIO()
    with redirect_stdout(printed), redirect_stderr(printed):
        try:
            # Empty lines before it make line numbers in a traceback those of the page.
            code = compile("\n" * (block["line"] - 1) + block["text"], block["page"], "exec")
            exec(code, names)  # noqa: S102 - running it is the test
        except BaseException:  # noqa: BLE001 - also what ends a program
            return False, printed.getvalue() + traceback.format_exc()
    return True, printed.getvalue()


def _bash(block: dict[str, Any]) -> tuple[bool, str]:
    shell = ["bash", "-euo", "pipefail", "-c", block["text"]]
    done = subprocess.run(
        shell, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False
    )
    return done.returncode == 0, done.stdout


if __name__ == "__main__":
    main()
