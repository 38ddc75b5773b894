"""Recordings of one camera: one numbering of all frames, their planes, hand-eye and splits."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float
from pydantic import Field, NonNegativeInt, field_validator
from torch import Tensor

from tofcorr.data.recording import (
    FrameBatch,
    Recording,
    frame_conditions,
    iterate_frames,
    pose_numbers,
)
from tofcorr.errors import CalibrationDataError
from tofcorr.estimation.accumulator import CHUNK_PIXELS, MomentAccumulator
from tofcorr.estimation.design import Design
from tofcorr.estimation.moments import ImageMoments, concatenate, stack
from tofcorr.geometry.rays import ray_directions
from tofcorr.options import Options
from tofcorr.pixels.distributed import everyones, own_share
from tofcorr.pixels.threads import in_threads, thread_number

Weighting = Callable[[FrameBatch], Tensor]
"""Gives the weights of a batch's pixels, shape (B, H, W), in 1/m^2 or without unit."""


@dataclass(frozen=True)
class Dataset:
    """Recordings that are calibrated together.

    A frame's global number counts over all recordings, those of the first recording first.

    Attributes:
        recordings: At least one; all of one camera.
        exclude: Returns True where a valid pixel of a batch is not used, shape (B, H, W); None
            uses all valid pixels. Fits and measured errors both leave these pixels out.
    """

    recordings: tuple[Recording, ...]
    exclude: Callable[[FrameBatch], Bool[Tensor, "B H W"]] | None = None

    def __post_init__(self) -> None:
        """Refuse recordings that are not of one camera in one setting."""
        if not self.recordings:
            raise CalibrationDataError("There is no recording to calibrate.")
        first = self.first
        for other in self.recordings[1:]:
            for name in ("camera", "depth_kind", "modulation_frequency"):
                if getattr(other, name) != getattr(first, name):
                    raise CalibrationDataError(
                        f"{other.path}: its {name} is {getattr(other, name)}, that of "
                        f"{first.path} is {getattr(first, name)}; recordings that are calibrated "
                        "together come from one camera in one setting."
                    )

            if other.frame_names.eye_to_hand != first.frame_names.eye_to_hand:
                raise CalibrationDataError(
                    f"{other.path}: the camera stands still in one of this and {first.path}, and "
                    "the robot carries it in the other; their hand-eye transforms differ."
                )

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

    def ray_directions(self) -> Float[Tensor, "H W 3"]:
        """Return the camera's unit rays, shape (H, W, 3), float64; shared, not to be written."""
        return ray_directions(self.first.camera)

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

    def conditions(self, frames: Sequence[int] | np.ndarray | None = None) -> Float[Tensor, "N C"]:
        """Return the conditions of frames (N, C) in the order of `CONDITIONS`; NaN: unknown."""
        every = torch.cat([frame_conditions(recording.frames) for recording in self.recordings])
        return every if frames is None else every[torch.as_tensor(np.asarray(frames))]

    def column(self, name: str) -> Tensor:
        """Return a column of numbers of all frames' tables, shape (N, ...), float64."""
        every = [getattr(recording.frames, name) for recording in self.recordings]
        return torch.from_numpy(np.concatenate(every))

    @property
    def targets(self) -> np.ndarray:
        """Each frame's target, shape (N,), text."""
        return np.concatenate([recording.frames.target for recording in self.recordings])

    def pose_groups(self) -> np.ndarray:
        """Return an integer a frame, shape (N,): frames taken without moving share it."""
        groups, start = [], 0
        for recording in self.recordings:
            group = pose_numbers(recording)
            groups.append(group + start)
            start += int(group.max()) + 1
        return np.concatenate(groups)

    def batches(
        self,
        frames: Sequence[int] | np.ndarray | None = None,
        device: str = "cpu",
        chunk_pixels: int = CHUNK_PIXELS,
        image_dtype: torch.dtype = torch.float64,
    ) -> Iterator[FrameBatch]:
        """Yield frames by their global numbers, in order, in batches of bounded size."""
        for recording, start, local in self.by_recording(frames):
            for batch in iterate_frames(
                recording, local, chunk_pixels, device=device, image_dtype=image_dtype
            ):
                numbered = replace(batch, indices=batch.indices + start)
                if self.exclude is not None:
                    numbered = replace(numbered, valid=batch.valid & ~self.exclude(numbered))
                yield numbered

    def moments(
        self,
        design: Design,
        frames: Sequence[int] | np.ndarray | None = None,
        weighting: Weighting | None = None,
        device: str = "cpu",
    ) -> ImageMoments:
        """Return the moments of the frames, in their order, from one pass.

        Processes started by `torchrun` share the pass; each returns the moments of all frames.
        """
        wanted = np.arange(self.num_frames) if frames is None else np.asarray(frames)
        # The static images are looked at in small pieces, which threads would wait for.
        with thread_number(1):
            accumulator = MomentAccumulator(design, device)
        own = own_share(wanted)
        # Images stay as recorded where nothing but the sums reads them: half the bytes.
        as_recorded = weighting is None and self.exclude is None
        as_recorded &= self.first.depth_kind == "radial"
        images = self.batches(
            own, device, image_dtype=torch.float32 if as_recorded else torch.float64
        )

        def moments_of(batch: FrameBatch) -> ImageMoments:
            return accumulator(batch, weighting(batch) if weighting else None)

        parts = in_threads(moments_of, images, None if device == "cpu" else 1)
        # A process may have no frame where there are more processes than frames.
        mine = [(self._in_order_read(own), stack(parts, len(own)))] if len(own) else []
        everything = [part for share in everyones(mine) for part in share]
        numbers = np.concatenate([indices for indices, _ in everything])
        return concatenate([moments for _, moments in everything]).images(_order(numbers, wanted))

    def _in_order_read(self, frames: np.ndarray) -> np.ndarray:
        """Return frames recording by recording, as `batches` yields them."""
        return np.concatenate([start + local for _, start, local in self.by_recording(frames)])

    def by_recording(
        self, frames: Sequence[int] | np.ndarray | None
    ) -> Iterator[tuple[Recording, int, np.ndarray]]:
        """Yield each recording concerned, the global number of its first frame, and its frames."""
        wanted = np.arange(self.num_frames) if frames is None else np.asarray(frames)
        start = 0
        for recording in self.recordings:
            inside = (wanted >= start) & (wanted < start + recording.num_frames)
            if inside.any():
                yield recording, start, wanted[inside] - start
            start += recording.num_frames


def _order(found: np.ndarray, wanted: np.ndarray) -> list[int]:
    """Return where each wanted frame lies among those found; both hold the same numbers."""
    order = np.empty(len(wanted), dtype=np.int64)
    order[np.argsort(wanted, kind="stable")] = np.argsort(found, kind="stable")
    return order.tolist()


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


# Fewest frames to train on: the covariance leaves out one pose of at least three.
_FEWEST_FRAMES = 3


class SplitOptions(Options):
    """Which frames are held out; frames of one pose always stay together.

    Attributes:
        test_fraction: Share of the poses that is held out; 0 trains on everything.
        seed: Seed of the random choice.
    """

    test_fraction: float = Field(default=0.5, ge=0.0, lt=1.0)
    seed: NonNegativeInt = 0


def split_frames(dataset: Dataset, options: SplitOptions) -> tuple[np.ndarray, np.ndarray]:
    """Return the global numbers of the frames to train on and to test on, both sorted.

    Raises:
        CalibrationDataError: Fewer than three frames would be left to train on.
    """
    group = dataset.pose_groups()
    order = np.random.default_rng(options.seed).permutation(int(group.max()) + 1)
    num_test = round(options.test_fraction * len(order))
    test = np.flatnonzero(np.isin(group, order[:num_test]))
    train = np.flatnonzero(~np.isin(group, order[:num_test]))
    if len(train) < _FEWEST_FRAMES:
        raise CalibrationDataError(
            f"{dataset.first.path}: {len(train)} of {dataset.num_frames} frames are left to train "
            f"on, {_FEWEST_FRAMES} are needed; record more, or set split.test_fraction to 0."
        )
    return train, test


def folds(dataset: Dataset, num_folds: int, seed: int) -> list[np.ndarray]:
    """Return the held-out frames of each fold; poses go to the folds at random, in equal numbers.

    Raises:
        CalibrationDataError: There are fewer poses than folds.
    """
    group = dataset.pose_groups()
    num_poses = int(group.max()) + 1
    if num_poses < num_folds:
        raise CalibrationDataError(
            f"{dataset.first.path}: {num_poses} poses cannot be divided into {num_folds} folds; "
            "record more, or ask for fewer folds."
        )
    order = np.random.default_rng(seed).permutation(num_poses)
    return [np.flatnonzero(np.isin(group, part)) for part in np.array_split(order, num_folds)]
