"""Recordings of one camera as one data set: numbering, planes, splits, ranges, and threads."""

import sys
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, nullcontext
from contextvars import ContextVar
from dataclasses import dataclass, replace
from functools import lru_cache
from operator import attrgetter
from os import PathLike
from pathlib import Path
from typing import Literal, TypeVar

import numpy as np
import torch
from jaxtyping import Float
from pydantic import Field, NonNegativeInt, field_validator
from threadpoolctl import ThreadpoolController
from torch import Tensor

from tofcorr.correction.state import CalibrationState
from tofcorr.data.recording import (
    CHUNK_PIXELS,
    FrameBatch,
    Recording,
    frame_conditions,
    iterate_frames,
    pose_numbers,
    repeat_numbers,
)
from tofcorr.errors import CalibrationDataError
from tofcorr.geometry.rays import Chosen, Rays, ray_directions
from tofcorr.options import Options
from tofcorr.pixels.direct import DirectDistance
from tofcorr.scene_light.stray import StrayLight, StrayLightState

Frames = Sequence[int] | np.ndarray
"""Numbers of frames."""


@dataclass(frozen=True)
class Dataset:
    """Recordings that are calibrated together.

    A frame's global number counts over all recordings, those of the first recording first.

    Attributes:
        recordings: At least one; all of one camera.
        exclude: Returns True where a valid pixel of a batch is not used, shape (B, H, W); None
            uses all valid pixels. Fits and measured errors both leave these pixels out.
        stray: Takes the camera's own stray light out of every frame that is read; None: nothing.
        direct: Takes second bounces out of the distances, after that; None: nothing.
    """

    recordings: tuple[Recording, ...]
    exclude: Callable[[FrameBatch], Chosen] | None = None
    stray: StrayLight | None = None
    direct: DirectDistance | None = None

    def __post_init__(self) -> None:
        """Refuse recordings that are not of one camera in one setting."""
        if not self.recordings:
            raise CalibrationDataError("There is no recording to calibrate.")
        first, *others = self.recordings
        for other in others:
            for name in ("camera", "depth_kind", "modulation_frequency", "frame_names.eye_to_hand"):
                one, its = map(attrgetter(name), (first, other))
                if its != one:
                    differ = f"its {name} is {its}, that of {first.path} is {one}"
                    need = "recordings that are calibrated together come from one camera"
                    raise CalibrationDataError(f"{other.path}: {differ}; {need} in one setting.")

    @property
    def first(self) -> Recording:
        """The first recording, which stands for the camera."""
        return self.recordings[0]

    @property
    def num_frames(self) -> int:
        """Frames of all recordings."""
        return sum(recording.num_frames for recording in self.recordings)

    @property
    def moves(self) -> bool:
        """Whether a robot moved the camera in any recording."""
        return any(recording.moves for recording in self.recordings)

    @property
    def planes_are_estimated(self) -> bool:
        """Whether an importer found planes of any recording in its depth: a start, never truth."""
        return any(recording.planes == "estimated" for recording in self.recordings)

    @property
    def has_amplitude(self) -> bool:
        """Whether every recording holds amplitudes."""
        return all(recording.amplitude is not None for recording in self.recordings)

    def ray_directions(self) -> Rays:
        """Return the camera's unit rays, shape (H, W, 3), float64; shared, not to be written."""
        return ray_directions(self.first.camera)

    def without(self, further: Callable[[FrameBatch], Chosen]) -> "Dataset":
        """Return the data set without further pixels: those where a function is True."""
        first = self.exclude
        exclude = further if first is None else lambda batch: first(batch) | further(batch)
        return replace(self, exclude=exclude)

    def without_stray_light(self, state: StrayLightState | None) -> "Dataset":
        """Return the data set as a camera without this stray light would have recorded it.

        Raises:
            CalibrationDataError: A recording has no amplitudes.
        """
        if state is None:
            return self
        self.require("amplitude", "taking stray light back")
        return replace(self, stray=StrayLight(self.first.camera, state))

    def without_second_bounces(self, state: CalibrationState) -> "Dataset":
        """Return the data set without the second bounces that a calibration removes, if it does."""
        removes = state.scene.second_bounces is not None
        poses = self.column("world_from_tool")
        return replace(self, direct=DirectDistance(state, poses)) if removes else self

    def require(self, name: str, needed_by: str) -> None:
        """Refuse a recording without an array, a column or a header entry, naming it.

        Args:
            name: What is needed.
            needed_by: What needs it, for the message.

        Raises:
            CalibrationDataError: A recording lacks it.
        """
        for recording in self.recordings:
            if name != "timestamp":  # Every recording has it.
                recording.require(name, needed_by)

    def conditions(self, frames: Frames | None = None) -> Float[Tensor, "N C"]:
        """Return the conditions of frames (N, C) in the order of `CONDITIONS`; NaN: unknown."""
        every = torch.cat([frame_conditions(recording.frames) for recording in self.recordings])
        return every if frames is None else every[torch.as_tensor(np.asarray(frames))]

    def column(self, name: str) -> Tensor:
        """Return a column of numbers of all frames' tables, shape (N, ...), float64."""
        every = [getattr(recording.frames, name) for recording in self.recordings]
        return torch.from_numpy(np.concatenate(every))

    def planes_and_poses(self, frames: Frames | None = None) -> tuple[Tensor, Tensor, Tensor]:
        """Return the planes of frames, normals (N, 3) and offsets (N,), and world_from_tool."""
        chosen = slice(None) if frames is None else torch.as_tensor(np.asarray(frames))
        names = "normal_world", "offset", "world_from_tool"
        return tuple(self.column(name)[chosen] for name in names)  # type: ignore[return-value]

    def with_columns(self, **values: np.ndarray) -> "Dataset":
        """Return the data set with other values in columns of its tables, of shape (N, ...)."""
        ends = np.cumsum([recording.num_frames for recording in self.recordings])[:-1]
        split = {name: np.split(column, ends) for name, column in values.items()}
        recordings = tuple(
            replace(one, frames=replace(one.frames, **{key: v[k] for key, v in split.items()}))
            for k, one in enumerate(self.recordings)
        )
        return replace(self, recordings=recordings)

    def plane_covariance(self) -> Float[Tensor, "N 4 4"] | None:
        """Return the covariances of (n, d) in the tool frame; None unless all recordings have them.

        Planes that were estimated have none: what is not known of them is all of them.
        """
        known = all(one.frames.plane_covariance is not None for one in self.recordings)
        pose, used = self.column("world_from_tool"), known and not self.planes_are_estimated
        return pose.mT @ self.column("plane_covariance") @ pose if used else None

    @property
    def targets(self) -> np.ndarray:
        """Each frame's target, shape (N,), text."""
        return np.concatenate([recording.frames.target for recording in self.recordings])

    def pose_groups(self) -> np.ndarray:
        """Return an integer a frame, shape (N,): frames taken without moving share it."""
        return self._numbered(pose_numbers)

    def repeat_groups(self) -> np.ndarray:
        """Return an integer a frame, shape (N,): frames that differ by noise alone share it."""
        return self._numbered(repeat_numbers)

    def _numbered(self, numbers_of: Callable[[Recording], np.ndarray]) -> np.ndarray:
        groups, start = [], 0
        for recording in self.recordings:
            group = numbers_of(recording)
            groups.append(group + start)
            start += int(group.max()) + 1
        return np.concatenate(groups)

    def batches(
        self,
        frames: Frames | None = None,
        device: str = "cpu",
        chunk_pixels: int = CHUNK_PIXELS,
        image_dtype: torch.dtype = torch.float64,
    ) -> Iterator[FrameBatch]:
        """Yield frames by their global numbers, in order, in batches of bounded size."""
        for recording, start, local in self.by_recording(frames):
            for batch in iterate_frames(recording, local, chunk_pixels, device, image_dtype):
                numbered = replace(batch, indices=batch.indices + start)
                if self.stray is not None:
                    stray = self.stray.to(batch.radial_distance)
                    distance, light = stray(batch.radial_distance, batch.amplitude)
                    numbered = replace(numbered, radial_distance=distance, amplitude=light)
                if self.direct is not None:
                    numbered = replace(numbered, radial_distance=self.direct(numbered))
                if self.exclude is not None:
                    numbered = replace(numbered, valid=batch.valid & ~self.exclude(numbered))
                yield numbered

    def by_recording(self, frames: Frames | None) -> Iterator[tuple[Recording, int, np.ndarray]]:
        """Yield each recording concerned, the global number of its first frame, and its frames."""
        wanted = np.arange(self.num_frames) if frames is None else np.asarray(frames)
        start = 0
        for recording in self.recordings:
            inside = (wanted >= start) & (wanted < start + recording.num_frames)
            if inside.any():
                yield recording, start, wanted[inside] - start
            start += recording.num_frames


Recordings = str | PathLike[str] | Recording | Sequence[str | PathLike[str] | Recording]
"""A folder, an opened recording, or a sequence of either."""


def opened(recordings: Recordings) -> tuple[Recording, ...]:
    """Return the recordings, opened.

    Raises:
        CalibrationDataError: A folder holds no recording.
    """
    if isinstance(recordings, (str, PathLike, Recording)):
        recordings = (recordings,)
    return tuple(
        one if isinstance(one, Recording) else Recording.open(Path(one)) for one in recordings
    )


PlaneChoice = Literal["auto", "known", "unknown"]
"""`known`: recorded planes are right; `unknown`: they are a start; `auto`: as `recording.yaml` says
(`planes: estimated` is unknown)."""


def resolved_planes(
    choice: PlaneChoice, recordings: Iterable[Recording]
) -> Literal["known", "unknown"]:
    """Return whether the planes are known: for `auto`, if those of every recording were measured.

    Args:
        choice: What the options say.
        recordings: The recordings that are fitted together.
    """
    if choice != "auto":
        return choice
    return "unknown" if any(one.planes == "estimated" for one in recordings) else "known"


class HandEyeOptions(Options):
    """Whether the hand-eye transform is estimated, and where its estimate starts.

    Attributes:
        estimate: `auto` estimates it if the tool moves, and uses the identity without a robot;
            `yes` estimates it; `no` uses the recording's.
        start: `auto` takes the better of a closed form from plane normals and the recording's own;
            `recording` starts from the recording's.
    """

    estimate: Literal["auto", "yes", "no"] = "auto"
    start: Literal["auto", "recording"] = "auto"

    @field_validator("estimate", mode="before")
    @classmethod
    def _in_words(cls, given: object) -> object:
        """Take YAML's own reading of a bare yes or no."""
        return {True: "yes", False: "no"}[given] if isinstance(given, bool) else given


def hand_eye_is_free(dataset: Dataset, options: HandEyeOptions) -> bool:
    """Whether the hand-eye transform is estimated; `auto` does so only if the tool moves."""
    return dataset.moves if options.estimate == "auto" else options.estimate == "yes"


def recorded_hand_eye(dataset: Dataset) -> Float[Tensor, "4 4"]:
    """Return tool_from_camera as the recording has it; the identity without a robot."""
    if not dataset.moves:
        return torch.eye(4, dtype=torch.float64)
    return torch.from_numpy(np.asarray(dataset.first.tool_from_camera, dtype=np.float64)).clone()


class SplitOptions(Options):
    """Which frames are held out; frames of one pose always stay together.

    Attributes:
        test_fraction: Share of the poses that is held out; 0 trains on everything.
        seed: Seed of the random choice.
    """

    test_fraction: float = Field(default=0.5, ge=0.0, lt=1.0)
    seed: NonNegativeInt = 0


def _poses(dataset: Dataset, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the pose of each frame, and all poses in a random order."""
    group = dataset.pose_groups()
    return group, np.random.default_rng(seed).permutation(int(group.max()) + 1)


def split_frames(dataset: Dataset, options: SplitOptions) -> tuple[np.ndarray, np.ndarray]:
    """Return the global numbers of the frames to train on and to test on, both sorted.

    Raises:
        CalibrationDataError: Fewer than three frames would be left to train on.
    """
    group, poses = _poses(dataset, options.seed)
    held_out = np.isin(group, poses[: round(options.test_fraction * len(poses))])
    test, train = np.flatnonzero(held_out), np.flatnonzero(~held_out)
    if len(train) < 3:  # The covariance leaves out one pose of at least three.
        left = f"{len(train)} of {dataset.num_frames} frames are left to train on, 3 are needed"
        advice = "record more, or set split.test_fraction to 0"
        raise CalibrationDataError(f"{dataset.first.path}: {left}; {advice}.")
    return train, test


def folds(dataset: Dataset, num_folds: int, seed: int) -> list[np.ndarray]:
    """Return the held-out frames of each fold; poses go to the folds at random, in equal numbers.

    Raises:
        CalibrationDataError: There are fewer poses than folds.
    """
    group, poses = _poses(dataset, seed)
    if len(poses) < num_folds:
        said = f"{len(poses)} poses cannot be divided into {num_folds} folds"
        advice = "record more, or ask for fewer folds"
        raise CalibrationDataError(f"{dataset.first.path}: {said}; {advice}.")
    return [np.flatnonzero(np.isin(group, part)) for part in np.array_split(poses, num_folds)]


Item = TypeVar("Item")
Result = TypeVar("Result")

# Torch's number of threads outside the outermost `thread_number`; 0 outside of all.
_at_once: ContextVar[int] = ContextVar("threads at once", default=0)


@lru_cache(maxsize=1)
def _libraries(modules: int) -> ThreadpoolController:
    """Return the libraries that threads share the work of, with so many modules imported."""
    return ThreadpoolController()


@contextmanager
def thread_number(threads: int | None) -> Iterator[None]:
    """Let so many threads share an operation of torch, NumPy or SciPy, while a block runs.

    Threads that share a small operation wait for one another longer than they compute; with matrix
    products of several threads a diagnosis took four times as long.

    Args:
        threads: How many; None: as many as the caller uses.
    """
    usual = torch.get_num_threads()
    before = _at_once.set(threads_at_once())
    if threads is not None:
        torch.set_num_threads(threads)
    try:
        # Which libraries are loaded is searched for again where a module was imported.
        blas = _libraries(len(sys.modules))
        with nullcontext() if threads is None else blas.limit(limits=threads, user_api="blas"):
            yield
    finally:
        torch.set_num_threads(usual)  # Last: a limit on products may set it too.
        _at_once.reset(before)


def threads_at_once() -> int:
    """Return how many threads may compute different things at once: the caller's own number."""
    return _at_once.get() or torch.get_num_threads()


def in_threads(
    work: Callable[[Item], Result], items: Iterable[Item], threads: int | None = None
) -> Iterator[Result]:
    """Return `work` of every item, in order; each thread takes a whole item and computes it alone.

    Args:
        work: May be called by several threads at once; its result must not depend on the order.
        items: Read by the caller's thread, only a few more than there are threads ahead.
        threads: How many; None: as many as the caller uses.
    """
    threads = threads_at_once() if threads is None else threads
    if threads < 2:
        yield from map(work, items)
        return
    gradients = torch.is_grad_enabled()

    def alone(item: Item) -> Result:
        torch.set_num_threads(1)
        with torch.set_grad_enabled(gradients):
            return work(item)

    waiting: deque[Future[Result]] = deque()
    with thread_number(1), ThreadPoolExecutor(threads) as pool:
        for item in items:
            waiting.append(pool.submit(alone, item))
            if len(waiting) > threads:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
