"""`tofcorr example`: every example is input that the command printed with it takes."""

import shlex
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml
from cameras import apart
from running import Program

import tofcorr
from tofcorr.errors import CalibrationDataError, ConfigError
from tofcorr.examples.example import EXAMPLES, example

IMPORTED = [name for name in EXAMPLES if "import" in EXAMPLES[name].command]


def truth(folder: Path) -> np.ndarray:
    return np.array(yaml.safe_load((folder / "truth.yaml").read_text())["tool_from_camera"])


def content(folder: Path) -> dict[str, bytes]:
    files = (path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in files}


def test_the_list_has_a_line_of_each_example_and_what_to_run_next(program: Program) -> None:
    code, out, _ = program("example")
    assert code == 0
    *lines, last = (line for line in out.splitlines() if line)
    assert [line.split()[0] for line in lines] == list(EXAMPLES)
    assert last == "Next: tofcorr example bag"


@pytest.mark.parametrize(
    "name",
    # The bag of another seed is imported by the page that begins with it.
    [pytest.param(one, marks=[pytest.mark.slow] if one == "bag" else []) for one in IMPORTED],
)
def test_the_command_printed_with_an_example_makes_a_recording_with_nothing_odd(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, program: Program
) -> None:
    """Another seed than the documents': frames of a steep wall passed for repeats that scatter."""
    monkeypatch.chdir(tmp_path)
    code, out, said = program("example", name, "--seed", 3)
    assert (code, said) == (0, "")
    following = out.splitlines()[-1].removeprefix("Next: ")
    assert program(*shlex.split(following)[1:]).code == 0
    recording = tmp_path / shlex.split(following)[-1]
    assert tofcorr.inspect(recording).findings == ()
    if name in ("bag", "images", "board"):
        start = tofcorr.Recording.open(recording).tool_from_camera
        assert (apart(start, truth(tmp_path / name)) < (15, 1.5)).all()
    assert sum(map(len, content(tmp_path / name).values())) < 4e6


def test_the_depth_of_the_simulator_has_no_error(tmp_path: Path) -> None:
    folder = example("simulator", tmp_path / "sim")
    recording = tofcorr.Recording.open(folder / "recording")
    depth = np.stack([np.load(path) for path in sorted((folder / "depth").iterdir())])
    pose = recording.frames.world_from_tool @ truth(folder)
    # The optical axis meets the plane at z = -(n . origin + d) / (n . axis).
    normal, offset = recording.frames.normal_world, recording.frames.offset
    along = np.einsum("fi,fi->f", normal, pose[:, :3, 2])
    z = -(np.einsum("fi,fi->f", normal, pose[:, :3, 3]) + offset) / along
    (_, _, u), (_, _, v) = recording.camera.matrix[:2]
    centre = depth[:, round(v), round(u)]
    np.testing.assert_allclose(centre, z, rtol=0.01)


@pytest.mark.parametrize("name", ["images", "recording"])
def test_one_seed_is_one_example_and_another_seed_another(name: str, tmp_path: Path) -> None:
    first, again, other = (
        content(example(name, tmp_path / f"{number}", seed))
        for number, seed in enumerate((1, 1, 2))
    )
    assert first == again
    assert first.keys() == other.keys() or name == "images"
    assert first != other


def test_what_cannot_be_written_is_refused_in_a_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(ConfigError, match=r"no example 'bog'. Did you mean 'bag'\? Known: bag, im"):
        example("bog", tmp_path / "bog")
    with pytest.raises(CalibrationDataError, match="exists already and is not overwritten"):
        example("bag", tmp_path)
    monkeypatch.setitem(sys.modules, "rosbags", None)
    with pytest.raises(
        CalibrationDataError, match=r"needs rosbags: pip install 'tofcorr\[rosbag\]'"
    ):
        example("bag", tmp_path / "bag")
    assert list(tmp_path.iterdir()) == []
