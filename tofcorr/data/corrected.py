"""A recording with its depth corrected, frame by frame."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from tofcorr.data.arrays import read_frames
from tofcorr.data.recording import Recording
from tofcorr.data.writing import RecordingWriter

Corrector = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]


@dataclass(frozen=True, kw_only=True)
class CorrectionSummary:
    """Number of frames and pixels corrected.

    Attributes:
        num_frames: Frames corrected.
        num_returns: Pixels on the target that had a return.
        num_valid: Those of them that are in the calibrated range.
    """

    num_frames: int
    num_returns: int
    num_valid: int


class CorrectedFrames(NamedTuple):
    """Some frames before and after correction, each array of shape (B, H, W).

    Attributes:
        depth: As recorded, metres.
        amplitude: As recorded; None without amplitudes.
        on_target: Where a pixel looks at the target, bool.
        corrected: Depth after correction, metres.
        kept: Where the correction is valid on the target, bool.
    """

    depth: np.ndarray
    amplitude: np.ndarray | None
    on_target: np.ndarray
    corrected: np.ndarray
    kept: np.ndarray


def corrected_frames(
    corrector: Corrector, recording: Recording, at_once: int
) -> Iterator[CorrectedFrames]:
    """Yield the frames of a recording in order, so many at once.

    Args:
        corrector: As for `write_corrected`.
        recording: The recording to correct.
        at_once: Largest number of frames that are read and corrected together.

    Raises:
        CalibrationDataError: `recording` is broken.
    """
    for start in range(0, recording.num_frames, at_once):
        chunk = np.arange(start, min(start + at_once, recording.num_frames))
        depth = read_frames(recording.depth, chunk)
        amplitude = recording.read("amplitude", chunk)
        mask = recording.read("mask", chunk)
        on_target = np.ones(depth.shape, dtype=bool) if mask is None else mask == 1
        given = np.full_like(depth, np.nan) if amplitude is None else amplitude
        corrected, valid = corrector(torch.from_numpy(depth), torch.from_numpy(given))
        yield CorrectedFrames(
            depth, amplitude, on_target, corrected.numpy(), on_target & valid.numpy()
        )


def write_corrected(
    corrector: Corrector,
    recording: Recording,
    path: Path | str,
    *,
    chunk_pixels: int = 2_000_000,
    progress: Callable[[int], object] = lambda frames: None,
) -> CorrectionSummary:
    """Write a copy of `recording` with corrected depth, in memory bounded by `chunk_pixels`.

    Rows, header and amplitude are copied. The mask is 1 where that of `recording` is 1 and the
    correction is valid. Raw samples are left out: they would contradict the depth.

    Args:
        corrector: Takes depth and amplitude, shape (B, H, W), float32, and returns corrected depth
            and where it is valid. If `recording` has no amplitude, it gets NaN.
        recording: The recording to correct.
        path: The folder to write; it must not exist yet.
        chunk_pixels: Pixels corrected at once, but at least one frame.
        progress: Called with the number of frames written since the last call.

    Raises:
        CalibrationDataError: `path` exists, cannot be written, or `recording` is broken.
    """
    camera = recording.camera
    step = max(1, chunk_pixels // (camera.height * camera.width))
    num_returns = num_valid = 0
    with RecordingWriter.like(path, recording) as writer, torch.inference_mode():
        for some in corrected_frames(corrector, recording, step):
            for i, frame in enumerate(some.corrected):
                amplitude = None if some.amplitude is None else some.amplitude[i]
                writer.append(frame, amplitude=amplitude, mask=some.kept[i])
            returned = (some.depth > 0) & np.isfinite(some.depth)
            num_returns += int((returned & some.on_target).sum())
            num_valid += int(some.kept.sum())
            progress(len(some.depth))
    return CorrectionSummary(
        num_frames=recording.num_frames, num_returns=num_returns, num_valid=num_valid
    )
