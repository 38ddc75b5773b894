"""A bag that is watched while a recorder writes it: read as far as it goes."""

import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import numpy as np
import pytest
from importing.posed_scene import Drive
from importing.rosbag import written_bags
from optional import present

from tofcorr.errors import CalibrationDataError
from tofcorr.examples import bags
from tofcorr.importing.images import DepthCoding
from tofcorr.importing.posed import PosedImport
from tofcorr.importing.robot_images import PosedOptions, RobotImages
from tofcorr.importing.rosbag.growing import GrowingBag, is_whole
from tofcorr.importing.rosbag.source import open_bag
from tofcorr.importing.run import Sieve
from tofcorr.live.watch import Watched


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("bags")


@pytest.fixture(scope="module", params=["mcap", "sqlite3"])
def whole(request: pytest.FixtureRequest, folder: Path) -> Path:
    drive = Drive(stops=5, width=16, height=12, rate=3.0).record()
    return written_bags.write_drive(drive, folder / request.param, request.param)


@contextmanager
def opened(path: Path, *, grows: bool = True) -> Iterator[tuple[RobotImages, PosedOptions]]:
    named = {"base_frame": bags.BASE, "tool_frame": bags.TOOL, "amplitude_topic": bags.INFRARED}
    with open_bag(path, bags.DEPTH, DepthCoding(), grows=grows, **named) as images:
        yield images, PosedOptions(images_per_stop=1)


def as_they_came(content: bytes) -> bytes:
    """Return an MCAP file without chunks, indexes and end, its messages in the order of time."""
    place, first, messages = 8, [content[:8]], []
    while content[place] != 0x0F:
        if content[place] == 6:  # A chunk has 40 bytes of its own, then records.
            place += 49
            continue
        size = 9 + int.from_bytes(content[place + 1 : place + 9], "little")
        record = content[place : place + size]
        if content[place] == 5:  # Behind channel and number, six bytes, its time.
            messages.append((int.from_bytes(record[15:23], "little"), record))
        elif content[place] != 7:
            first.append(record)
        place += size
    return b"".join(first + [record for _, record in sorted(messages)])


def write_share(whole: Path, growing: Path, share: float) -> None:
    """Write what a recorder would have written of a bag at a share of the time."""
    growing.mkdir(exist_ok=True)
    for path in whole.glob("*.mcap"):
        content = as_they_came(path.read_bytes())
        (growing / path.name).write_bytes(content[: int(share * len(content))])
    for path in whole.glob("*.db3"):
        (growing / path.name).write_bytes(path.read_bytes())
        with closing(sqlite3.connect(growing / path.name)) as base, base:
            first, last = base.execute(
                "SELECT min(timestamp), max(timestamp) FROM messages"
            ).fetchone()
            end = first + int(share * (last - first))
            base.execute("DELETE FROM messages WHERE timestamp > ?", (end,))


def test_what_is_complete_is_read_and_the_rest_waited_for(whole: Path, tmp_path: Path) -> None:
    with opened(whole, grows=False) as (images, _):
        every = {name: images.read(k) for k, name in enumerate(images.names)}
    names: list[str] = []
    for share in (0.5, 0.501, 1.0):
        write_share(whole, tmp_path / "bag", share)
        with opened(tmp_path / "bag") as (images, _):
            assert names == images.names[: len(names)]
            names = list(images.names)
            for k, name in enumerate(names):
                np.testing.assert_array_equal(images.read(k).depth, every[name].depth)
    assert names == [*every]
    assert is_whole(whole)
    assert not is_whole(tmp_path / "bag")
    with pytest.raises(CalibrationDataError), opened(tmp_path / "bag", grows=False):
        pass


def test_a_bag_that_grows_ends_with_the_frames_that_an_import_of_it_gives(
    tmp_path: Path,
) -> None:
    drive = Drive(stops=12, width=32, height=24, rate=3.0, one_wall=True).record()
    whole = written_bags.write_drive(drive, tmp_path, "mcap")
    growing = tmp_path / "growing"
    growing.mkdir()
    bag = GrowingBag(growing, lambda: opened(growing))
    watched = Watched(growing, "e0", bag)
    assert watched.poll() == 0
    assert watched.note.startswith("No frame can be used so far: ")
    write_share(whole, growing, 0.7)
    bag._rests_until = 0.0
    assert watched.poll() > 0
    assert watched.poll() == 0
    (growing / "metadata.yaml").write_text((whole / "metadata.yaml").read_text())
    for path in whole.iterdir():
        (growing / path.name).write_bytes(path.read_bytes())
    bag._rests_until = 0.0
    assert watched.poll() > 0
    assert watched.note == "The bag is complete."
    with opened(whole) as (images, options):
        prepared = PosedImport(images, options, {}).prepare(Sieve("bag"))
        frames = list(prepared.frames)
    imported = [(row.target, row.timestamp, np.sum(present(mask))) for row, _, _, mask in frames]
    live = present(watched.live)
    assert sorted(imported) == sorted(
        (x.row.target, x.row.timestamp, int(live._sums[k].moments.count))
        for k, x in live._frames.items()
    )
