"""`tofcorr watch`: adds the frames of a folder as they come, and shows what is known in a browser.

The page is one file without a network; what changes reaches it as server-sent events, one state in
JSON for each frame. The server listens on this machine alone, and answers two addresses.
"""

import base64
import io
import json
import math
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import partial
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.image import imsave

from tofcorr.data.arrays import IMAGE_ARRAYS, ImageArray
from tofcorr.data.recording import HEADER_FILE, read_header
from tofcorr.data.table import TABLE_FILE, FrameRow, read_table
from tofcorr.errors import CalibrationDataError, TofcorrError
from tofcorr.files import reading, scratch_folder
from tofcorr.live.calibration import START_FILE, Known, LiveCalibration
from tofcorr.live.frames import coverage, seen_from
from tofcorr.pages.page import page_text
from tofcorr.training.run import Config

_POLL_S = 0.2
_LOCAL = ("127.0.0.1", "localhost")
# Most points of a curve, and ellipses, that a page draws. Chosen: more are not told apart.
_MOST_POINTS, _MOST_ELLIPSES = 200, 8


class Watched:
    """A folder that grows, the calibration of its frames, and the newest state of the page.

    Args:
        source: A recording whose files grow, or the folder of a `LiveCalibration`.
        config: As of `LiveCalibration`; a folder of one has its own.
        more: What else `LiveCalibration` takes: `wanted_mm`, `wanted_deg`, `folder`.

    Raises:
        CalibrationDataError: The folder is neither.
    """

    def __init__(self, source: Path, config: Config = "ea", **more: Any) -> None:  # noqa: ANN401
        self.source, self.changed = source, threading.Condition()
        self.damaged: list[str] = []
        self._history: list[tuple[int, float | None, float | None]] = []
        self._ellipses: list[list[float]] = []
        self._next, self._depth = 0, None
        self._seen: set[Path] = set()
        self.state: dict[str, Any] = {}
        if (source / START_FILE).exists():
            self.live = LiveCalibration.started(source)
            self._new = self._new_sums
        elif (source / HEADER_FILE).exists():
            header = read_header(source / HEADER_FILE)
            self._planes_are_known = header.planes == "recorded"
            self.live = LiveCalibration(header.recording(source), config, **more)
            self._new = self._new_frames
        else:
            said = f"expected a recording ({HEADER_FILE}) or a live calibration ({START_FILE})"
            raise CalibrationDataError(f"{source}: {said} that grows.")
        self._publish(None)

    def poll(self) -> int:
        """Add the frames that are there and were not added, and return how many."""
        added = 0
        for name, add in self._new():
            added += 1
            try:
                self._publish(add())
            except TofcorrError as error:
                self.damaged.append(f"{name} was skipped: {error}")
                self._publish(self.live.known)
        return added

    def _new_sums(self) -> Iterator[tuple[str, Callable[[], Known]]]:
        """Yield the frames that another process has added, each with what adds it here."""
        for file in sorted(set(self.source.glob("frame-*.pt")) - self._seen):
            self._seen.add(file)
            yield file.name, partial(self.live.take, file)

    def _new_frames(self) -> Iterator[tuple[str, Callable[[], Known]]]:
        """Yield the frames whose row and images are complete."""
        table = self.source / TABLE_FILE
        if not table.exists():
            return
        with reading(table):
            text = table.read_text(encoding="utf-8-sig")
        # A row that is being written has no end yet.
        head, *rows = text[: text.rfind("\n") + 1].splitlines() or [""]
        rows = [row for row in rows if row.strip()]
        size = self.live.camera.height, self.live.camera.width
        names = ("depth", "amplitude", "mask")
        arrays = [one for name in names if (one := IMAGE_ARRAYS[name]).file(self.source).exists()]
        if not any(one.required for one in arrays):
            return
        while self._next < len(rows):
            frame = self._next
            images = {
                one.name: image
                for one in arrays
                if (image := _frame_of(one, self.source, frame, size)) is not None
            }
            if len(images) < len(arrays):
                return
            self._next += 1
            yield f"Frame {frame}", partial(self._add, head, rows[frame], images)

    def _add(self, head: str, row: str, images: dict[str, np.ndarray]) -> Known:
        cells = _row_of(head, row)
        self._depth = images["depth"]
        return self.live.add_frame(cells, **images, plane_is_known=self._planes_are_known)

    def _publish(self, known: Known | None) -> None:
        """Compute the state of the page, once for each frame."""
        live = self.live
        state: dict[str, Any] = {
            "frames": len(live),
            "poses": 0 if known is None else known.poses,
            "verdict": "No frame yet." if known is None else repr(known).partition("\n")[0],
            "odd": [] if known is None else list(known.odd),
            "enough": known is not None and known.enough,
            "wanted": [live.wanted_mm, live.wanted_deg],
            "damaged": self.damaged[-5:],
            "image": None if self._depth is None else _png(self._depth),
            "cover": coverage(live.frames, live.camera, live.tool_from_camera),
            "next": None,
        }
        if known is not None:
            shift, turn = (_finite(x) for x in (known.translation_mm, known.rotation_deg))
            self._history.append((known.poses, shift, turn))
            if len(self._history) > _MOST_POINTS:
                self._history = self._history[::2]
            state |= {"weakest": known.weakest, "next": _next_pose(live)}
            if known.fit is not None and shift is not None:
                self._ellipses.append(_ellipse(known))
                if len(self._ellipses) > _MOST_ELLIPSES:
                    del self._ellipses[1]
        state |= {"history": self._history, "ellipses": self._ellipses, "at": time.time()}
        with self.changed:
            self.state = state
            self.changed.notify_all()


class _Handler(BaseHTTPRequestHandler):
    """Answers the page and its events to programs on this machine, and nothing else."""

    def __init__(self, watched: Watched, page: str, *request: Any) -> None:  # noqa: ANN401
        self._watched, self._page = watched, page
        super().__init__(*request)

    def do_GET(self) -> None:
        """Answer one request."""
        # A page of another site may give its name the address of this machine.
        if self.headers.get("Host", "").partition(":")[0] not in _LOCAL:
            self.send_error(HTTPStatus.FORBIDDEN)
        elif self.path == "/":
            self._begin("text/html; charset=utf-8")
            self.wfile.write(self._page.encode())
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
                with self._watched.changed:
                    if self._watched.state is last:
                        self._watched.changed.wait(1.0)
                    state = self._watched.state
                # A line without a state finds out whether somebody still listens.
                text = ":\n\n" if state is last else f"data: {json.dumps(state)}\n\n"
                self.wfile.write(text.encode())
                last = state

    def log_message(self, format: str, *args: object) -> None:
        """Say nothing of requests."""


def serve(watched: Watched, port: int = 0) -> ThreadingHTTPServer:
    """Return a server of the page on 127.0.0.1, which runs in a thread; `shutdown` ends it."""
    page = page_text("tofcorr.live", "watch.html.j2", {}, {}, source=watched.source.name)
    server = ThreadingHTTPServer((_LOCAL[0], port), partial(_Handler, watched, page))
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


def _row_of(head: str, row: str) -> FrameRow:
    """Return one row of frames.csv, which the reader checks as a table of its own."""
    number, _, rest = row.partition(",")
    with scratch_folder() as folder:
        table = folder / TABLE_FILE
        table.write_text(f"{head}\n0,{rest}\n", encoding="utf-8")
        try:
            return read_table(table).row(0)
        except CalibrationDataError as error:
            said = str(error).replace(str(table), TABLE_FILE).replace("frame 0", f"frame {number}")
            raise CalibrationDataError(said) from None


def _png(depth: np.ndarray) -> str:
    """Return depth (H, W) in false colours, blue near and yellow far, as the text of a PNG."""
    step = max(1, depth.shape[1] // 320)
    small = np.where(depth > 0, depth, np.nan)[::step, ::step]
    buffer = io.BytesIO()
    if np.isfinite(small).any():
        low, high = np.nanquantile(small, [0.02, 0.98])
        imsave(buffer, small, vmin=low, vmax=high, cmap="viridis", format="png")
    return base64.b64encode(buffer.getvalue()).decode()


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _ellipse(known: Known) -> list[float]:
    """Return half axes (mm) and turn (degrees) of the 95 % ellipse across and down the image."""
    assert known.fit is not None
    values, vectors = torch.linalg.eigh(known.fit.hand_eye_covariance[:2, :2])
    # The 95 % quantile of the sum of two squares.
    half = 1e3 * (values.clamp(min=0) * -2 * math.log(1 / 20)).sqrt()
    return [*half.tolist()[::-1], math.degrees(math.atan2(vectors[1, 1], vectors[0, 1]))]


def _next_pose(live: LiveCalibration) -> dict[str, Any] | None:
    """Return the next pose, and what the camera would see from it: distance, tilt and roll."""
    pose = live.next_pose()
    if pose is None:
        return None
    distance, tilt, roll = seen_from(pose, live.frames[-1].row, live.tool_from_camera)
    return {"pose": pose.round(4).tolist(), "distance": distance, "tilt": tilt, "roll": roll}
