"""`tofcorr watch`: adds frames as they come, and shows in a browser what is known with them.

The page is one file without a network; what changes reaches it as server-sent events, one state in
JSON for each frame. The server listens on this machine alone, and answers two addresses.
"""

import base64
import io
import json
import math
import os
import re
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import partial
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from matplotlib.image import imsave

from tofcorr.data.arrays import IMAGE_ARRAYS, ImageArray
from tofcorr.data.recording import HEADER_FILE, Header, Recording, read_header
from tofcorr.data.table import TABLE_FILE, FrameRow, read_lines, read_table
from tofcorr.errors import CalibrationDataError, ConfigError, TofcorrError
from tofcorr.files import being_written, reading
from tofcorr.live.calibration import START_FILE, Known, LiveCalibration
from tofcorr.live.frames import coverage, seen_from
from tofcorr.pages.page import page_text
from tofcorr.training.run import Config

if TYPE_CHECKING:  # A bag is read by an importer, which this room does not know.
    from tofcorr.importing.rosbag.growing import GrowingBag

_New = tuple[Any, str, Callable[[], tuple[Known, np.ndarray | None]]]
"""What a frame is called in its source, and in words, and what adds it."""

_POLL_S = 0.2
# Least time between two states of the page while frames are added that were there before, seconds.
# Chosen: as often as somebody looks.
_SHOWN_S = 1.0
_LOCAL = ("127.0.0.1", "localhost")
# Most points of a curve, ellipses, bars, and sentences that a page shows. Chosen: more are not told
# apart, or not read.
_MOST_POINTS, _MOST_ELLIPSES, _BARS, _MOST_SENTENCES = 200, 8, 8, 5


class LivePage:
    """What the page shows of a live calibration: its newest state, of a size that does not grow.

    Args:
        title: What is watched.
    """

    def __init__(self, title: str) -> None:
        self.title, self.changed = title, threading.Condition()
        self.said: list[str] = []
        self._history: list[tuple[int, float | None, float | None]] = []
        self._ellipses: list[list[float]] = []
        self._depth: np.ndarray | None = None
        self._at = time.time()
        self.publish(None)

    def add(self, known: Known, depth: np.ndarray | None = None) -> None:
        """Take what a frame has told.

        Args:
            known: What `LiveCalibration.add` returned.
            depth: Of the frame, shape (H, W), metres, to be shown; None: it is not known.
        """
        self._depth, self._at = depth, time.time()
        self.said += [f"Frame {known.frame} {one}" for one in known.odd]
        shift, turn = (_finite(x) for x in (known.translation_mm, known.rotation_deg))
        self._history.append((known.poses, shift, turn))
        if len(self._history) > _MOST_POINTS:
            # The one whose neighbours are nearest to each other.
            poses = np.array([one[0] for one in self._history])
            del self._history[1 + int((poses[2:] - poses[:-2]).argmin())]
        if known.fit is not None and shift is not None:
            self._ellipses.append(_ellipse(known))
            if len(self._ellipses) > _MOST_ELLIPSES:
                # Of two that differ least in size, the older one.
                sizes = np.log([one[0] for one in self._ellipses])
                del self._ellipses[int(np.abs(np.diff(sizes)).argmin())]

    def publish(self, live: LiveCalibration | None, note: str = "") -> None:
        """Show what is known now, and when it is found, the next pose.

        Args:
            live: The calibration; None: nothing is known of the camera yet.
            note: What is to be said of the source of frames; empty: it may grow.
        """
        known = None if live is None else live.known
        state: dict[str, Any] = {
            "frames": 0 if live is None else len(live),
            "verdict": "No frame yet." if known is None else repr(known).partition("\n")[0],
            "said": self.said[-_MOST_SENTENCES:],
            "note": note,
            "enough": known is not None and known.enough,
            "image": None if self._depth is None else _png(self._depth),
            "history": self._history,
            "ellipses": self._ellipses,
            "at": self._at,
        }
        if live is not None and known is not None:
            state |= {
                "wanted": [live.wanted_mm, live.wanted_deg],
                "weakest": known.weakest,
                "cover": _bars(coverage(live.frames, live.tool_from_camera)),
            }
        self._show(state)
        if live is not None:
            self._show(state | {"next": _next_pose(live)})

    def _show(self, state: dict[str, Any]) -> None:
        with self.changed:
            self.state = state
            self.changed.notify_all()


class Watched:
    """A source of frames that grows, the calibration of them, and the page that shows it.

    Args:
        source: A recording that grows, or that `RecordingWriter` is going to write; a bag; or the
            folder of a `LiveCalibration`.
        config: As of `LiveCalibration`; a folder of one has its own.
        bag: Reads `source` if that is a bag.
        page: Shows it; None: a new one.
        more: What else `LiveCalibration` takes: `wanted_mm`, `wanted_deg`, `folder`.

    Raises:
        CalibrationDataError: Something else is at `source`.
    """

    def __init__(
        self,
        source: Path,
        config: Config = "ea",
        bag: "GrowingBag | None" = None,
        page: LivePage | None = None,
        **more: Any,  # noqa: ANN401
    ) -> None:
        self.source, self.page = source, page or LivePage(source.name)
        self.live: LiveCalibration | None = None
        self.note = ""
        self._begin = partial(LiveCalibration, config=config, **more)
        self._bag, self._new = bag, self._new_frames
        # By what they are called in the source: numbers of frames; None: a frame was refused.
        self._taken: dict[object, int | None] = {}
        self._staged, self._rests_until = False, 0.0
        if bag is not None:
            self._new = self._new_images
        elif (source / START_FILE).exists():
            self.live, self._new = LiveCalibration.started(source), self._new_sums
        elif (source / HEADER_FILE).exists():
            self._live(lambda: read_header(source / HEADER_FILE))
        elif os.path.lexists(source):
            said = f"expected a recording ({HEADER_FILE}) or a live calibration ({START_FILE})"
            raise CalibrationDataError(f"{source}: {said} that grows. Of a bag, name --depth.")

    def poll(self) -> int:
        """Add the frames that are there and were not added, and return how many."""
        note, added = self.note, 0
        for key, name, add in self._new():
            added += 1
            self._taken[key] = None
            try:
                known, depth = add()
                self._taken[key] = known.frame
                self.page.add(known, depth)
            except TofcorrError as error:
                self.page.said.append(f"{name} was skipped: {error}")
            if time.monotonic() > self._rests_until:
                self._publish()
        if added or note != self.note:
            self._publish()
        return added

    def _publish(self) -> None:
        began = time.monotonic()
        self.page.publish(self.live, self.note)
        # Frames that wait are added for half of the time at least.
        self._rests_until = max(began + _SHOWN_S, 2 * time.monotonic() - began)

    def _new_sums(self) -> Iterator[_New]:
        """Yield the frames that another process has added."""
        live = self.live
        assert live is not None
        for file in sorted(set(self.source.glob("frame-*.pt")) - self._taken.keys()):
            yield file, file.name, lambda file=file: (live.take(file), None)

    def _new_images(self) -> Iterator[_New]:
        """Yield the images of a bag that an import of it would take, and take out the others."""
        assert self._bag is not None
        try:
            with self._bag.so_far() as found:
                if found is None:
                    return
                keywords = found.writer.keywords
                live = self._live(lambda: Recording(path=self.source, **keywords).header)
                self.note = "The bag is complete." if self._bag.whole else ""
                keys = [(str(one["view"]), one["wall"]) for one in found.views]
                for key in self._taken.keys() - {*keys}:
                    if (number := self._taken.pop(key)) is not None:
                        live.remove(number)
                for key, (row, *three) in zip(keys, found.frames, strict=True):
                    if key not in self._taken:
                        images = dict(zip(("depth", "amplitude", "mask"), three, strict=True))
                        yield key, f"Image {key[0]}", partial(self._add, row, **images)
        except CalibrationDataError as error:
            self.note = f"No frame can be used so far: {error}"

    def _new_frames(self) -> Iterator[_New]:
        """Yield the frames of a recording, or of one that a program writes beside its place."""
        folder = being_written(self.source, TABLE_FILE) or self.source
        if not folder.exists():
            gone = "The program that wrote it has ended, and has kept no recording."
            self.note = gone if self.live is not None else f"Nothing is at {self.source} yet."
            return
        self.note = "The recording is complete." if self._staged and folder == self.source else ""
        self._staged |= folder != self.source
        try:
            yield from self._frames_in(folder)
        except CalibrationDataError:
            if folder.exists():
                raise  # Otherwise the writer has renamed it.

    def _frames_in(self, folder: Path) -> Iterator[_New]:
        """Yield the frames whose row and images are complete."""
        camera = self._live(lambda: read_header(folder / HEADER_FILE)).camera
        table = folder / TABLE_FILE
        head, *rows = (read_lines(table, grows=True) if table.exists() else []) or [[]]
        size = camera.height, camera.width
        names = ("depth", "amplitude", "mask")
        arrays = [one for name in names if (one := IMAGE_ARRAYS[name]).file(folder).exists()]
        if not any(one.required for one in arrays):
            return
        for frame in range(len(self._taken), len(rows)):
            images = {
                one.name: image
                for one in arrays
                if (image := _frame_of(one, folder, frame, size)) is not None
            }
            if len(images) < len(arrays):
                return
            row = partial(_row_of, head, rows[frame], frame)
            yield frame, f"Frame {frame}", lambda row=row, own=images: self._add(row(), **own)

    def _live(self, header: Callable[[], Header]) -> LiveCalibration:
        """Return the calibration, begun with a header where it is asked for first."""
        if self.live is None:
            begun = header()
            self._planes_are_known = begun.planes == "recorded"
            self.live = self._begin(begun.recording(self.source))
        return self.live

    def _add(self, row: FrameRow, **images: Any) -> tuple[Known, np.ndarray]:  # noqa: ANN401
        """Add a frame; return what is known with it, and its depth."""
        assert self.live is not None
        known = self.live.add_frame(row, **images, plane_is_known=self._planes_are_known)
        return known, images["depth"]


class _Handler(BaseHTTPRequestHandler):
    """Answers the page and its events to programs on this machine, and nothing else."""

    def __init__(self, page: LivePage, text: str, *request: Any) -> None:  # noqa: ANN401
        self._page, self._text = page, text
        super().__init__(*request)

    def do_GET(self) -> None:
        """Answer one request."""
        # A page of another site may give its name the address of this machine.
        if self.headers.get("Host", "").partition(":")[0] not in _LOCAL:
            self.send_error(HTTPStatus.FORBIDDEN)
        elif self.path == "/":
            self._begin("text/html; charset=utf-8")
            self.wfile.write(self._text.encode())
        elif self.path == "/events":
            self._begin("text/event-stream")
            self._send_states()
        else:
            self.send_error(HTTPStatus.NOT_FOUND)

    def _begin(self, kind: str) -> None:
        self.send_response(HTTPStatus.OK)
        self.send_header("Content-Type", kind)
        self.send_header("Cache-Control", "no-store")
        self.end_headers()

    def _send_states(self) -> None:
        last: object = None
        with suppress(OSError):  # Nobody listens any more.
            while True:
                with self._page.changed:
                    if self._page.state is last:
                        self._page.changed.wait(1.0)
                    state = self._page.state
                # A line without a state finds out whether somebody still listens.
                text = ":\n\n" if state is last else f"data: {json.dumps(state)}\n\n"
                self.wfile.write(text.encode())
                last = state

    def log_message(self, format: str, *args: object) -> None:
        """Say nothing of requests."""


def serve(page: LivePage, port: int = 0) -> ThreadingHTTPServer:
    """Return a server of the page on 127.0.0.1, which runs in a thread; `shutdown` ends it.

    Raises:
        ConfigError: The port cannot be had.
    """
    text = page_text("tofcorr.live", "watch.html.j2", {}, {}, source=page.title)
    try:
        server = ThreadingHTTPServer((_LOCAL[0], port), partial(_Handler, page, text))
    except (OSError, OverflowError) as error:
        said = f"The page cannot have port {port} ({getattr(error, 'strerror', error)})"
        raise ConfigError(f"{said}; choose another, or 0 for any free one (--port).") from None
    server.daemon_threads = True
    threading.Thread(target=server.serve_forever, daemon=True).start()
    return server


def watch(watched: Watched, *, ends: Callable[[], bool] = lambda: False) -> None:
    """Add frames until `ends`, or Ctrl-C."""
    while not ends():
        if not watched.poll():
            time.sleep(_POLL_S)


def _frame_of(
    array: ImageArray, folder: Path, frame: int, size: tuple[int, int]
) -> np.ndarray | None:
    """Return a frame by the size of its file, whose header is finished last; None: not there."""
    path = array.file(folder)
    with reading(path), path.open("rb") as file:
        try:
            np.lib.format.read_magic(file)
            np.lib.format.read_array_header_1_0(file)
        except ValueError:  # The header itself is being written.
            return None
        image = np.empty(array.frame_shape(*size), array.dtype)
        file.seek(file.tell() + frame * image.nbytes)
        return image if file.readinto(image.data.cast("B")) == image.nbytes else None


def _row_of(head: list[str], row: list[str], frame: int) -> FrameRow:
    """Return one row of frames.csv, which the reader checks as a table of its own."""
    cells = [
        "0" if name.strip() == "frame" and re.fullmatch(f"0*{frame}", cell.strip()) else cell
        for name, cell in zip(head, row, strict=False)
    ]
    try:
        return read_table(Path(TABLE_FILE), [head, cells + row[len(head) :]]).row(0)
    except CalibrationDataError as error:
        said = str(error).replace("frame 0", f"frame {frame}")
        raise CalibrationDataError(said.replace("expected 0 (", f"expected {frame} (")) from None


def _png(depth: np.ndarray) -> str:
    """Return depth (H, W) in false colours, blue near and yellow far, as the text of a PNG."""
    step = max(1, depth.shape[1] // 320)
    small = np.where(depth > 0, depth, np.nan)[::step, ::step]
    buffer = io.BytesIO()
    if np.isfinite(small).any():
        low, high = np.nanquantile(small, [0.02, 0.98])
        imsave(buffer, small, vmin=low, vmax=high, cmap="viridis", format="png")
    return base64.b64encode(buffer.getvalue()).decode()


def _bars(cover: dict[str, list[float]]) -> dict[str, Any]:
    """Return the lists of what frames cover, other than parts of the image, as bars of counts."""
    bars: dict[str, Any] = {"image": cover.pop("image")}
    for name, values in cover.items():
        ends = (min(values), max(values)) if values else (0.0, 0.0)
        count = np.histogram(values, _BARS, ends)[0].tolist()
        bars[name] = {"count": count, "low": ends[0], "high": ends[1]} if values else None
    return bars


def _finite(value: float) -> float | None:
    return float(f"{value:.4g}") if math.isfinite(value) else None


def _ellipse(known: Known) -> list[float]:
    """Return half axes (mm) and turn (degrees) of the camera's place across and down the image.

    It is the outline of an ellipsoid whose longest half axis is `translation_mm`.
    """
    assert known.fit is not None
    covariance = known.fit.hand_eye_covariance[:3, :3]
    values, vectors = torch.linalg.eigh(covariance[:2, :2])
    worst = torch.linalg.eigvalsh(covariance)[-1]
    half = known.translation_mm * (values.clamp(min=0) / worst).sqrt()
    return [*half.tolist()[::-1], math.degrees(math.atan2(vectors[1, 1], vectors[0, 1]))]


def _next_pose(live: LiveCalibration) -> dict[str, Any] | None:
    """Return the next pose, and what the camera would see from it: distance, tilt and roll."""
    pose = live.next_pose()
    if pose is None:
        return None
    distance, tilt, roll = seen_from(pose, live.frames[-1].row, live.tool_from_camera)
    return {"pose": pose.round(4).tolist(), "distance": distance, "tilt": tilt, "roll": roll}
