"""Everything that must hold before a merge: format, lint, layers, size, types, tests.

Arguments go to pytest; `python scripts/test.py -m slow` runs the long checks. Runs with the Python
that has tofcorr and its `test` extra installed; `bash scripts/test.sh` installs them first.
"""

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
REAL_DATA = ROOT.parent / "shared" / "real"
"""Where the folder of real recordings stands in a development checkout, if anywhere."""


def main() -> None:
    """Run all checks; end with the exit code of one that fails."""
    if not os.environ.get("TOFCORR_REAL_DATA") and REAL_DATA.is_dir():
        os.environ["TOFCORR_REAL_DATA"] = str(REAL_DATA)
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # Two test workers share two cores.
    programs = Path(sys.executable).parent
    # Each worker runs neighbouring tests, which share fixtures, and takes others when it is done.
    workers = ["-n", "2", "--dist", "worksteal"]
    tests = ["pytest", *workers, *(sys.argv[1:] or ["-m", "not slow and not gpu"])]
    for name, *arguments in (
        ["ruff", "format", "--check", "--quiet", "."],
        ["ruff", "check", "--quiet", "."],
        ["lint-imports"],
        ["python", "scripts/census.py"],
    ):
        _end_unless(subprocess.run([programs / name, *arguments], cwd=ROOT, check=False).returncode)
    # The type checker uses one core and waits for files; the tests take what it leaves.
    with subprocess.Popen([programs / "pyright"], cwd=ROOT, stdout=subprocess.PIPE) as types:
        tested = subprocess.run([programs / tests[0], *tests[1:]], cwd=ROOT, check=False).returncode
        sys.stdout.buffer.write(types.communicate()[0])
        sys.stdout.flush()
    _end_unless(types.returncode)
    _end_unless(tested)


def _end_unless(code: int) -> None:
    """End with an exit code other than 0."""
    if code:
        sys.exit(code)


if __name__ == "__main__":
    main()
