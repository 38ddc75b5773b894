"""The page of a recording that grows: what it says, whom it answers, and what it survives."""

import json
import shutil
import socket
import threading
from collections.abc import Generator
from contextlib import closing
from http.client import HTTPConnection
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from simulated_walls import simulated_wall

import tofcorr
from tofcorr.live.calibration import LiveCalibration
from tofcorr.live.watch import Watched, serve, watch

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
    server.shutdown()
    server.server_close()


def test_a_folder_of_neither_kind_is_refused(tmp_path: Path) -> None:
    with pytest.raises(tofcorr.CalibrationDataError, match="expected a recording"):
        Watched(tmp_path)
