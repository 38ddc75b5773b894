"""Damaged files of other programs end in one sentence, never in a traceback."""

import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from fuzzed import MANY, read_or_refused
from importing.posed_scene import Drive
from importing.rosbag import written_bags

from benchmarks import fuzz
from tofcorr.examples import bags
from tofcorr.importing.images import DepthCoding
from tofcorr.importing.robot_images import ImagesOfPlanes, PosedOptions
from tofcorr.importing.rosbag.source import open_bag
from tofcorr.importing.run import Sieve


def read_bag(path: Path) -> None:
    """Read everything that an import reads of a bag."""
    named = {"base_frame": bags.BASE, "tool_frame": bags.TOOL, "amplitude_topic": bags.INFRARED}
    with open_bag(path, bags.DEPTH, DepthCoding(), grows=False, **named) as images:
        ImagesOfPlanes(images, PosedOptions()).look(Sieve("bag"))


@pytest.fixture(scope="module", params=written_bags.KINDS)
def bag(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> fuzz.Target:
    few = Drive(stops=3, width=8, height=6, rate=3).record().take(np.arange(4))
    path = written_bags.write_drive(few, tmp_path_factory.mktemp("bag"), request.param)
    if path.is_dir():
        path = next(one for one in path.iterdir() if one.suffix != ".yaml")
    return fuzz.Target(path.name, path.read_bytes(), read_bag)


@pytest.mark.filterwarnings("ignore")  # What is drawn to be odd: numbers of other types.
@pytest.mark.parametrize("examples", [40, MANY])
@pytest.mark.parametrize("target", fuzz.imports(), ids=lambda target: target.name)
def test_damage_is_read_or_refused(target: fuzz.Target, examples: int, tmp_path: Path) -> None:
    read_or_refused(target, tmp_path, examples)


@pytest.mark.parametrize("examples", [20, MANY])
def test_a_damaged_bag_is_read_or_refused(bag: fuzz.Target, examples: int, tmp_path: Path) -> None:
    read_or_refused(bag, tmp_path, examples)


def test_an_image_of_too_many_pixels_is_refused(tmp_path: Path) -> None:
    """A process of its own: OpenCV reads the limit when it is imported."""
    cv2.imwrite(str(tmp_path / "image.png"), np.zeros((12_000, 12_000), np.uint8))
    code = "import sys; from pathlib import Path; from tofcorr.importing.images import read_array; "
    given = [sys.executable, "-c", code + "read_array(Path(sys.argv[1]))", tmp_path / "image.png"]
    told = subprocess.run(given, capture_output=True, text=True, check=False)
    assert "image.png is not a readable image" in told.stderr
