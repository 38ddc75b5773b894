"""The whole job on simulated cameras: calibrate one, and diagnose a second against its simulator.

Runs with the Python that has tofcorr installed; `bash scripts/run.sh` installs it first.
"""

import json
import os
import shlex
import shutil
import sys
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any

import click
import yaml

from tofcorr.cli.main import group, set_up_threads
from tofcorr.diagnosis.report.words import axis_label
from tofcorr.errors import TofcorrError

FIRST_CAMERA = """
simulate --config demo --out {out}/recording
train --config ea --recording {out}/recording --out {out}/run
evaluate --config paper --recording {out}/recording --out {out}/evaluation
export --run {out}/run --format lut --out {out}/corrector.npz
correct --model {out}/run/corrector.ts --recording {out}/recording --out {out}/corrected
"""
SECOND_CAMERA = """
example simulator --out {out}/second
diagnose --recording {out}/second/recording --sim diagnosis --out {out}/diagnosis
"""


def main() -> None:
    """Run the job in the folder given, `runs/demo` without one; stop at the first failure."""
    out = Path(sys.argv[1] if len(sys.argv) > 1 else "runs/demo")
    if out.exists():
        shutil.rmtree(out)
    out.mkdir(parents=True)
    set_up_threads(os.environ)
    try:
        # The cameras do not know each other: each has a process of its own.
        with ProcessPoolExecutor(1) as other:
            second = other.submit(_printed, SECOND_CAMERA, out)
            _run(FIRST_CAMERA, out)
            click.echo(second.result())
    except TofcorrError as error:
        click.echo(f"Error: {error}", err=True)
        sys.exit(2)
    for number, line in enumerate(findings(out), 1):
        click.echo(f"{number}. {line}")
    pages = [out / of / "report.html" for of in ("run", "diagnosis")]
    click.echo(f"Pages: {' and '.join(str(page) for page in pages if page.exists())}")


def _run(commands: str, out: Path) -> None:
    """Run commands in this process, each shown first."""
    for line in commands.strip().splitlines():
        words = [word.format(out=out) for word in shlex.split(line)]
        click.echo(f"\n$ tofcorr {shlex.join(words)}")
        group(words, standalone_mode=False)


def _printed(commands: str, out: Path) -> str:
    """Run commands in this process, and return what they print."""
    with redirect_stdout(StringIO()) as printed, redirect_stderr(printed):
        _run(commands, out)
    return printed.getvalue()


def findings(out: Path) -> Iterator[str]:
    """Say in eight lines what the job found, with the numbers of its files."""
    report = _json(out / "run" / "report.json")
    rms = {stage: parts["test"]["rms"] for stage, parts in report["error_mm"].items()}
    yield f"Camera 1 was off by {rms['before']:.1f} mm RMS, on images kept out of the fit."
    only, after = rms["hand_eye_only"], rms["after"]
    yield f"Its place on the robot corrected: {only:.1f} mm. Its depth as well: {after:.1f} mm."

    truth = yaml.safe_load((out / "recording" / "truth" / "truth.yaml").read_text(encoding="utf-8"))
    found, true = (_millimetres(one["tool_from_camera"]) for one in (report["hand_eye"], truth))
    errors = ", ".join(f"{error:.1f}" for error in report["hand_eye"]["translation_se_mm"])
    yield f"It sits at {found} mm on the tool, ± {errors} mm; the truth is {true} mm."

    evaluation = _json(out / "evaluation" / "evaluation.json")
    half = evaluation["sets"][0]["held_out"]["half"]["error_mm"]["rms_mm"]
    models = {name: half[name]["mean"] for name in evaluation["columns"][2:]}
    best = min(models, key=lambda name: models[name])
    compared = f"Of {', '.join(models)}, {best} is best with {models[best]:.1f} mm"
    yield f"{compared}; the verdict on the calibration is '{report['verdict']}'."

    diagnosis = _json(out / "diagnosis" / "diagnosis.json")
    as_given, calibrated, explained = (stage["gap_mm"] for stage in diagnosis["stages"])
    remain = f"{calibrated:.1f} mm of it remain after calibration"
    yield f"Camera 2 and its simulator differ by {as_given:.1f} mm; {remain}."
    where = diagnosis["where"][0]
    name, *unit = axis_label(where["covariate"]).rsplit(", ", 1)
    ends = f"{where['from']:g} to {where['to']:g}"
    along = " ".join([name, "from", ends, *unit])
    yield f"Where: along {along} it changes by {where['bias_mm']:.1f} mm."
    effects = ", ".join(diagnosis["effects"]) or "no effect that it knows"
    yield f"Which: {effects} is missing, of probability {diagnosis['probability']:.2f}."
    low, high = diagnosis["gap_mm"]["after_ci"]
    shrunk = f"{calibrated:.1f} to {explained:.1f} mm"
    yield f"How far: with it the difference shrinks from {shrunk} (95 %: {low:.1f} to {high:.1f})."


def _millimetres(transform: list[list[float]]) -> str:
    return ", ".join(f"{1e3 * row[3]:.1f}" for row in transform[:3])


def _json(path: Path) -> dict[str, Any]:
    return json.loads(path.read_text(encoding="utf-8"))


if __name__ == "__main__":
    main()
