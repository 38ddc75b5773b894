"""The main job on a simulated recording: simulate, train, evaluate, export, correct.

Runs with the Python that has tofcorr installed; `bash scripts/run.sh` installs it first.
"""

import shutil
import subprocess
import sys
from pathlib import Path


def main() -> None:
    """Run the job in the folder given, `runs/demo` without one; stop at the first failure."""
    out = Path(sys.argv[1] if len(sys.argv) > 1 else "runs/demo")
    if out.exists():
        shutil.rmtree(out)
    out.mkdir(parents=True)
    recording = ["--recording", out / "recording"]
    for arguments in (
        ["simulate", "--config", "demo", "--out", out / "recording"],
        ["train", "--config", "ea", *recording, "--out", out / "run"],
        ["evaluate", "--config", "paper", *recording, "--out", out / "evaluation"],
        ["export", "--run", out / "run", "--format", "lut", "--out", out / "corrector.npz"],
        ["correct", "--model", out / "run/corrector.ts", *recording, "--out", out / "corrected"],
    ):
        command = [sys.executable, "-m", "tofcorr", *map(str, arguments)]
        code = subprocess.run(command, check=False).returncode
        if code:
            sys.exit(code)
    print(
        f"Done. Look at {out / 'run' / 'report.json'}, {out / 'evaluation'}, and: "
        f"tensorboard --logdir {out / 'run' / 'tb'}"
    )


if __name__ == "__main__":
    main()
