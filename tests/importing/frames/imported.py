"""`tofcorr import ...` as the tests call it."""

import json
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from click.testing import CliRunner
from importing import scene_files
from importing.posed_scene import Recorded

from tofcorr.cli.main import group
from tofcorr.data.recording import Recording
from tofcorr.errors import TofcorrError
from tofcorr.examples import files


class Imported(NamedTuple):
    """What an import left behind.

    Attributes:
        exit_code: 2 for bad input.
        text: Everything printed, the error's message included.
        recording: None if it was refused.
        report: `import.json`; empty if it was refused.
    """

    exit_code: int
    text: str
    recording: Recording | None
    report: dict[str, Any]

    @property
    def done(self) -> Recording:
        """The recording of an import that was not refused."""
        assert self.recording is not None, self.text
        return self.recording

    @property
    def refusal(self) -> str:
        """What an import said that was refused."""
        assert self.exit_code == 2, self.text
        return self.text

    def reasons(self) -> dict[str, str]:
        """Return why each view was left out; of several reasons the last."""
        return {one["view"]: one["reason"] for one in self.report["refused"]}


def run_import(door: str, *arguments: object, out: Path) -> Imported:
    """Run `tofcorr import DOOR ARGUMENTS --out OUT`; only errors meant for people are caught."""
    command = ["import", door, *map(str, arguments), "--out", str(out)]
    result = CliRunner().invoke(group, command)
    if isinstance(result.exception, TofcorrError):
        assert not out.exists()
        return Imported(2, str(result.exception), None, {})
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    if result.exit_code:
        return Imported(result.exit_code, result.output, None, {})
    report = json.loads((out / "import.json").read_text(encoding="utf-8"))
    return Imported(0, result.output, Recording.open(out), report)


def import_png(recorded: Recorded, folder: Path, *arguments: object) -> Imported:
    """Write PNG and TUM, and import them."""
    scene_files.write_png(recorded, folder)
    track = recorded.pose_times, recorded.world_from_tool
    poses = files.write_tum(*track, folder / "poses.txt")
    return import_written(recorded, folder, "png", poses, *arguments)


def import_written(
    recorded: Recorded, folder: Path, ending: str, poses: Path, *arguments: object
) -> Imported:
    """Import what was written into a folder."""
    intrinsics = files.write_intrinsics(recorded, folder / "camera.yaml")
    patterns = ("--depth", f"depth/*.{ending}", "--amplitude", f"ir/*.{ending}")
    given = ("--poses", poses, "--intrinsics", intrinsics)
    return run_import("frames", folder, *patterns, *given, *arguments, out=folder / "out")


def assert_equal_recordings(first: Recording, second: Recording, quantum: float) -> None:
    """Depth equal to its quantum, poses and planes to 1e-6, the rest exactly."""
    assert first.amplitude is not None
    assert np.mean(np.asarray(first.mask) != np.asarray(second.mask)) < 1e-4
    for name, far in (("depth", quantum), ("amplitude", 0)):
        mine, theirs = (np.asarray(getattr(one, name)) for one in (first, second))
        np.testing.assert_allclose(mine, theirs, rtol=0, atol=far)
    for name, far in (("world_from_tool", 1e-6), ("normal_world", 1e-5), ("offset", 1e-5)):
        mine, theirs = (getattr(one.frames, name) for one in (first, second))
        np.testing.assert_allclose(mine, theirs, rtol=0, atol=far)
    np.testing.assert_array_equal(first.frames.target, second.frames.target)
