"""The page of a recording that grows: what it says, whom it answers, and what it survives."""

import json
import shutil
import socket
import threading
from collections.abc import Callable, Generator
from contextlib import closing, suppress
from dataclasses import replace
from http.client import HTTPConnection
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from optional import present
from simulated_walls import simulated_wall

import tofcorr
from tofcorr.data.recording import Recording
from tofcorr.data.writing import RecordingWriter
from tofcorr.files import being_written
from tofcorr.live.calibration import LiveCalibration
from tofcorr.live.watch import LivePage, Watched, serve, watch

IMAGES = ("depth", "amplitude")


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("watch") / "wall"
    simulated_wall(folder, shots=(("white", 15),))
    return folder


class Growing:
    """A recording to which the frames of another one are appended."""

    def __init__(self, whole: Path, folder: Path) -> None:
        self.folder, self.next = folder, 0
        folder.mkdir()
        shutil.copy(whole / "recording.yaml", folder)
        self.head, *self.rows = (whole / "frames.csv").read_text().splitlines()
        self.images = {name: np.load(whole / f"{name}.npy") for name in IMAGES}
        (folder / "frames.csv").write_text(self.head + "\n")
        for name, image in self.images.items():
            np.save(folder / f"{name}.npy", image[:0])

    def append(self, part: str, text: bytes) -> None:
        with (self.folder / part).open("ab") as file:
            file.write(text)

    def grow(self, row: str | None = None) -> None:
        for name, image in self.images.items():
            self.append(f"{name}.npy", image[self.next].tobytes())
        self.append("frames.csv", f"{row or self.rows[self.next]}\n".encode())
        self.next += 1


@pytest.fixture
def growing(whole: Path, tmp_path: Path) -> Growing:
    return Growing(whole, tmp_path / "growing")


def states(port: int) -> Generator[dict[str, Any]]:
    connection = HTTPConnection("127.0.0.1", port, timeout=20)
    connection.request("GET", "/events")
    with closing(connection), connection.getresponse() as answer:
        for line in answer:
            if line.startswith(b"data: "):
                yield json.loads(line[6:])


def test_the_stream_says_what_the_calibration_knows(growing: Growing) -> None:
    watched, ended = Watched(growing.folder), threading.Event()
    server = serve(watched.page)
    stream = states(server.server_port)
    thread = threading.Thread(target=watch, args=(watched,), kwargs={"ends": ended.is_set})
    thread.start()
    try:
        for count in (15,):  # Of five poses it rests on where the solver started.
            while growing.next < count:
                growing.grow()
            # The next pose follows in a state of its own.
            said = next(one for one in stream if one["frames"] == count and "next" in one)
            recording = growing.folder
            live = LiveCalibration.resume(filled(growing, recording.with_name(f"live{count}")))
            assert live.known is not None
            # How well it is known rests, of so few poses, on rounding: the poses do not.
            assert said["verdict"].startswith(f"{live.known.poses} poses: the hand-eye")
            assert np.shape(said["next"]["pose"]) == (4, 4)
    finally:
        ended.set()
        thread.join()
        stream.close()
        server.shutdown()
        server.server_close()


def filled(growing: Growing, folder: Path) -> Path:
    """Write a live calibration of the same frames, and return its folder."""
    watched = Watched(growing.folder, folder=folder)
    watched.poll()
    again = Watched(folder)
    assert again.poll() == growing.next
    assert again.page.state["frames"] == watched.page.state["frames"]
    return folder


def test_what_is_half_written_is_waited_for(growing: Growing) -> None:
    watched = Watched(growing.folder)
    assert watched.poll() == 0
    growing.append("frames.csv", growing.rows[0].encode())
    assert watched.poll() == 0
    growing.append("frames.csv", b"\n")
    half = {name: image[0].tobytes() for name, image in growing.images.items()}
    growing.append("depth.npy", half["depth"])
    growing.append("amplitude.npy", half["amplitude"][:100])
    assert watched.poll() == 0
    growing.append("amplitude.npy", half["amplitude"][100:])
    assert watched.poll() == 1
    assert watched.page.said == []


def test_a_damaged_frame_is_named_and_skipped(growing: Growing) -> None:
    growing.grow()
    growing.grow(growing.rows[1].replace(",", ",nonsense", 1))
    growing.grow()
    watched = Watched(growing.folder)
    assert watched.poll() == 3
    assert watched.page.state["frames"] == 2
    assert len(watched.page.said) == 1
    assert watched.page.said[0].startswith("Frame 1 was skipped: frames.csv: frame 1, column")


def test_columns_are_known_by_their_names(growing: Growing) -> None:
    order = np.random.default_rng(1).permutation(len(growing.head.split(",")))

    def shuffled(line: str) -> str:
        return ",".join(np.array(line.split(","))[order])

    for _ in range(2):
        growing.grow()
    same = Watched(growing.folder)
    same.poll()
    rows = "\n".join(map(shuffled, [growing.head, *growing.rows[:2]]))
    (growing.folder / "frames.csv").write_text(rows + "\n")
    other = Watched(growing.folder)
    assert other.poll() == 2
    assert other.page.said == []
    lives = present(same.live), present(other.live)
    for one, two in zip(*(live.frames for live in lives), strict=True):
        np.testing.assert_array_equal(one.row.world_from_tool, two.row.world_from_tool)
    grams = [[one.moments.gram for one in live._sums.values()] for live in lives]
    torch.testing.assert_close(*grams)
    growing.append("frames.csv", f"{shuffled(growing.rows[1])}\n".encode())
    for name, image in growing.images.items():
        growing.append(f"{name}.npy", image[2].tobytes())
    assert other.poll() == 1
    assert (
        "frame 2, column 'frame': expected 2 (counting up from zero), got '1'" in other.page.said[0]
    )


def writer_of(whole: Path, folder: Path) -> tuple[RecordingWriter, Callable[[int], None]]:
    """Begin a recording; return the writer, and what appends a frame of another recording."""
    one = Recording.open(whole)
    names = ("camera", "depth_kind", "modulation_frequency", "tool_from_camera", "planes")
    writer = RecordingWriter(folder, **{name: getattr(one, name) for name in names})

    def append(k: int) -> None:
        assert one.amplitude is not None
        row = one.frames.row(k)
        row = replace(row, integration_time=5e-4 if k else None)  # A column that comes later.
        writer.append(one.depth[k], row=row, amplitude=one.amplitude[k])

    return writer, append


def test_what_tofcorr_writes_is_seen_before_it_is_there(whole: Path, tmp_path: Path) -> None:
    watched = Watched(tmp_path / "wall")
    assert watched.poll() == 0
    assert watched.note == f"Nothing is at {tmp_path / 'wall'} yet."
    writer, append = writer_of(whole, tmp_path / "wall")
    with writer:
        assert watched.poll() == 0
        for k in range(2):
            append(k)
            assert watched.poll() == 1
            assert watched.page.state["frames"] == k + 1
        assert watched.note == ""
        assert not (tmp_path / "wall").exists()
        (hidden,) = tmp_path.iterdir()
        with pytest.raises(tofcorr.CalibrationDataError, match="stand behind the array"):
            Recording.open(hidden)
        append(2)
    assert watched.poll() == 1
    assert watched.note == "The recording is complete."
    rows = [one.row for one in present(watched.live).frames]
    assert [row.integration_time for row in rows] == [None, 5e-4, 5e-4]
    assert watched.page.said == []


@pytest.mark.parametrize("killed", [False, True])
def test_a_writer_that_stops_before_the_end_is_said(
    killed: bool, whole: Path, tmp_path: Path
) -> None:
    place = tmp_path / "wall"
    watched = Watched(place)
    writer, append = writer_of(whole, place)
    hidden = tmp_path
    with suppress(KeyboardInterrupt), writer:
        append(0)
        assert watched.poll() == 1
        (hidden,) = tmp_path.iterdir()
        if killed:  # Nobody holds the folder of a killed writer any more.
            shutil.copytree(hidden, tmp_path / "left")
        raise KeyboardInterrupt
    if killed:
        (tmp_path / "left").rename(hidden)
    assert watched.poll() == 0
    assert "has ended, and has kept no recording" in watched.page.state["note"]
    assert being_written(place, "frames.csv") is None
    assert watched.page.state["frames"] == 1


def test_the_state_of_the_page_does_not_grow(whole: Path) -> None:
    watched = Watched(whole)
    watched.poll()
    page, live = watched.page, present(watched.live)
    known, sizes = present(live.known), list[int]()
    for count in (300, 2000):
        for _ in range(count):
            page.add(replace(known, odd=("is odd.",)), np.ones((480, 640)))
        page.publish(live)
        sizes.append(len(json.dumps(page.state)))
    assert sizes[1] < 1.5 * sizes[0]
    assert sum(page.state["cover"]["distance"]["count"]) == len(live)


def test_only_this_machine_is_answered(growing: Growing) -> None:
    server = serve(Watched(growing.folder).page)
    answers = {}
    for host, path in (("localhost:1", "/"), ("evil.example:1", "/"), ("localhost:1", "/x")):
        connection = HTTPConnection("127.0.0.1", server.server_port, timeout=5)
        connection.request("GET", path, headers={"Host": host})
        answers[host, path] = connection.getresponse().status
        connection.close()
    assert list(answers.values()) == [200, 403, 404]
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.2", server.server_port), timeout=2)
    for port in (server.server_port, 99_999):
        with pytest.raises(tofcorr.ConfigError, match=f"cannot have port {port} .*--port"):
            serve(LivePage("another"), port)
    server.shutdown()
    server.server_close()


def test_a_folder_of_neither_kind_is_refused(tmp_path: Path) -> None:
    with pytest.raises(tofcorr.CalibrationDataError, match="expected a recording"):
        Watched(tmp_path)
