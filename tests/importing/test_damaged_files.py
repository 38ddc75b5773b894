"""Damaged bags and pose files end in one sentence, never in a traceback."""

from collections.abc import Callable
from functools import reduce
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from importing import scene_files
from importing.posed_scene import Drive, Recorded
from importing.rosbag import written_bags as bags

from tofcorr.errors import TofcorrError
from tofcorr.importing.images import DepthCoding
from tofcorr.importing.pose_files import read_poses
from tofcorr.importing.robot_images import ImagesOfPlanes, PosedOptions
from tofcorr.importing.rosbag.source import open_bag
from tofcorr.importing.run import Sieve

Damage = tuple[bool, float, float, bytes]
"""What is done: whether in place, where it begins and ends (shares of the file), and new bytes."""

DAMAGES = st.tuples(st.booleans(), st.floats(0, 1), st.floats(0, 1), st.binary(max_size=8))


def damaged(content: bytes, damage: Damage) -> bytes:
    """Overwrite in place; or replace a part, which cuts out, inserts or truncates."""
    in_place, start, end, new = damage
    first, last = sorted((int(start * len(content)), int(end * len(content))))
    return content[:first] + new + content[first + len(new) if in_place else last :]


@pytest.fixture(scope="module")
def few() -> Recorded:
    recorded = Drive(stops=3, width=8, height=6, rate=3).record()
    return recorded.take(np.arange(4))


@pytest.fixture(scope="module")
def pose_files(few: Recorded, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("poses")
    poses = few.world_from_tool[:6]
    npy = folder / "poses.npy"
    np.save(npy, poses)
    return [
        scene_files.write_tum(few.pose_times[:6], poses, folder / "tum.txt"),
        scene_files.write_csv(poses, folder / "poses.csv"),
        scene_files.write_matrices(poses, folder / "matrices.txt"),
        scene_files.write_moveit(poses, folder / "samples.yaml"),
        npy,
    ]


@pytest.fixture(scope="module")
def bag_files(few: Recorded, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    found = []
    for kind in bags.KINDS:
        path = bags.write_drive(few, tmp_path_factory.mktemp(kind), kind)
        found.append(
            path if path.is_file() else next(p for p in path.iterdir() if p.suffix != ".yaml")
        )
    return found


def read_bag(path: Path) -> None:
    """Read everything that an import reads of a bag."""
    frames = {"base_frame": bags.BASE, "tool_frame": bags.TOOL}
    topics = {"amplitude_topic": bags.INFRARED}
    with open_bag(path, bags.DEPTH, DepthCoding(), **frames, **topics) as images:
        ImagesOfPlanes(images, PosedOptions()).look(Sieve("bag"))


def run(files: list[Path], read: Callable[[Path], object], folder: Path, examples: int) -> None:
    """Read damaged files; only an error meant for people may come."""
    contents = [(folder / f"damaged{file.suffix}", file.read_bytes()) for file in files]

    @settings(
        max_examples=examples,
        suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture],
    )
    @given(chosen=st.sampled_from(contents), damages=st.lists(DAMAGES, min_size=1, max_size=3))
    def law(chosen: tuple[Path, bytes], damages: list[Damage]) -> None:
        path, content = chosen
        path.write_bytes(reduce(damaged, damages, content))
        said = "nothing"
        try:
            read(path)
        except TofcorrError as error:
            said = str(error)
        assert said
        assert "\n" not in said

    for path, content in contents:
        path.write_bytes(content)
        read(path)  # Undamaged.
    law()


MANY = pytest.param(1000, marks=pytest.mark.slow)


@pytest.mark.parametrize("examples", [150, MANY])
def test_damaged_pose_files_end_in_one_sentence(
    pose_files: list[Path], tmp_path: Path, examples: int
) -> None:
    run(pose_files, read_poses, tmp_path, examples)


@pytest.mark.parametrize("examples", [60, MANY])
def test_damaged_bags_end_in_one_sentence(
    bag_files: list[Path], tmp_path: Path, examples: int
) -> None:
    run(bag_files, read_bag, tmp_path, examples)
