"""Damaged bags and pose files end in one sentence, never in a traceback."""

from collections.abc import Callable
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
from tofcorr.importing.robot_images import look
from tofcorr.importing.rosbag.source import open_bag
from tofcorr.importing.run import Sieve

Damage = tuple[int, float, float, bytes]
"""What is done: an operation, where it begins and ends (shares of the file), and new bytes."""

DAMAGES = st.tuples(
    st.integers(0, 3), st.floats(0, 1), st.floats(0, 1), st.binary(min_size=1, max_size=8)
)


def damaged(content: bytes, damage: Damage) -> bytes:
    """Overwrite, insert, cut out, or truncate."""
    operation, start, end, new = damage
    first, last = sorted((int(start * len(content)), int(end * len(content))))
    if operation == 0:
        return content[:first] + new + content[first + len(new) :]
    if operation == 1:
        return content[:first] + new + content[first:]
    if operation == 2:
        return content[:first] + content[last:]
    return content[:first]


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
        look(images, Sieve("bag"))


def survives(read: Callable[[Path], object], path: Path, content: bytes) -> None:
    """Read damaged content; only an error meant for people may come."""
    path.write_bytes(content)
    said = "nothing"
    try:
        read(path)
    except TofcorrError as error:
        said = str(error)
    assert said
    assert "\n" not in said


def run(files: list[Path], read: Callable[[Path], object], folder: Path, examples: int) -> None:
    contents = [(file.suffix, file.read_bytes()) for file in files]
    target = {suffix: folder / f"damaged{suffix}" for suffix, _ in contents}

    @settings(
        max_examples=examples,
        suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture],
    )
    @given(
        chosen=st.integers(0, len(contents) - 1), damages=st.lists(DAMAGES, min_size=1, max_size=3)
    )
    def law(chosen: int, damages: list[Damage]) -> None:
        suffix, content = contents[chosen]
        for damage in damages:
            content = damaged(content, damage)
        survives(read, target[suffix], content)

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


def test_undamaged_bags_and_pose_files_are_read(
    bag_files: list[Path], pose_files: list[Path]
) -> None:
    for path in bag_files:
        read_bag(path)
    assert [len(read_poses(path)) for path in pose_files] == [6] * 5
