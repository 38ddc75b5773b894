"""`python -m benchmarks.scene_light.kinect2 RECORDING`: flying pixels of a real Kinect v2.

They are compared with pixels marked by hand in `kinect2_marks.yaml`, and taken out of the board and
what surrounds it: `tofcorr import checkerboard` wrote the recording.
"""

import argparse
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
import yaml

from tofcorr.correction.corrector import DepthCorrector
from tofcorr.correction.state import SceneLight
from tofcorr.options import resolve_options
from tofcorr.pixels.dataset import Dataset, Frames, opened
from tofcorr.pixels.masks import raw_errors
from tofcorr.training.calibration import TrainingOptions
from tofcorr.training.run import calibration_state, train

GROWN = (0, 20, 40)  # pixels by which the board is grown: its rim is within 20, the chair's beyond
OTHER = 0.1  # metres off the plane of the board from which a pixel sees something else
MARKS = Path(__file__).with_name("kinect2_marks.yaml")


class Seen:
    """Frames corrected by a calibration, and their flying pixels."""

    def __init__(self, data: Dataset, options: TrainingOptions, false_alarm: float) -> None:
        runtime = options.runtime.model_validate({"flying_pixels": {"false_alarm": false_alarm}})
        calibration = train(data.recordings, options)
        options = options.model_copy(update={"runtime": runtime})
        self.state = calibration_state(calibration.data, options, calibration.fit)
        self.data, self.held_out = calibration.data, calibration.calibration.test
        plain = self.state.model_copy(update={"scene": SceneLight()})
        self.corrector = DepthCorrector.from_state(plain)
        found = self.state.flying_pixels()
        assert found is not None, "the recording shows flying pixels"
        self.finder = found

    def frames(self, which: Frames) -> Iterator[tuple[int, np.ndarray, np.ndarray, np.ndarray]]:
        """Yield number, returns, flying pixels, and errors along the ray to the board's plane."""
        for batch in self.data.batches(which):
            assert batch.amplitude is not None
            depth = (batch.radial_distance / self.corrector.radial_of_z).float()
            amplitude = batch.amplitude.float()
            corrected, _ = self.corrector(depth, amplitude)
            flying, _ = self.finder.found(corrected, amplitude)
            distance = (corrected * self.corrector.radial_of_z).double()
            own = replace(batch, radial_distance=distance)
            error = raw_errors(own, self.data.ray_directions(), self.state.tool_from_camera)
            frames = batch.indices.tolist(), corrected.isfinite(), flying, error
            yield from zip(frames[0], *(one.numpy() for one in frames[1:]), strict=True)


def compared(seen: Seen) -> str:
    """Precision and recall against the marks."""
    marks = yaml.safe_load(MARKS.read_text())
    judged = {True: 0, False: 0}
    missed = 0
    for frame, returns, flying, _ in seen.frames(sorted(marks)):
        row, column, height, width = marks[frame]["part"]
        part, marked = np.zeros_like(returns), np.zeros_like(returns)
        part[row : row + height, column : column + width] = True
        for own, columns in marks[frame]["marked"].items():
            marked[own, columns] = True
        part &= returns
        for truth in judged:
            judged[truth] += int((part & flying & (marked == truth)).sum())
        missed += int((part & marked & ~flying).sum())
    hits = judged[True]
    precision, recall = hits / (hits + judged[False]), hits / (hits + missed)
    return f"precision {100 * precision:.1f} %, recall {100 * recall:.1f} % of {hits + missed}"


def around_the_board(seen: Seen, grown: int) -> str:
    """Held-out RMS of the board grown by so many pixels, with and without flying pixels."""
    from scipy.ndimage import binary_dilation

    masks, every, kept = seen.data.first.mask, [], []
    assert masks is not None
    for frame, _, flying, error in seen.frames(seen.held_out):
        board = np.asarray(masks[frame]) > 0
        used = binary_dilation(board, iterations=grown) if grown else board
        used = np.logical_and(used, np.abs(error) < OTHER)
        every.append(error[used])
        kept.append(error[used & ~flying])
    before, after = (np.concatenate(parts) for parts in (every, kept))
    rms = [1e3 * float(np.sqrt(np.mean(one**2))) for one in (before, after)]
    share = 100 * (1 - len(after) / len(before))
    return (
        f"grown by {grown:2}: {rms[0]:.2f} mm, without flying pixels {rms[1]:.2f} ({share:.2f} %)"
    )


def main() -> None:
    """Print both for some rates of false alarms."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("recording", type=Path)
    parser.add_argument("--false-alarm", type=float, nargs="+", default=[1e-4, 1e-3, 1e-2])
    given = parser.parse_args()
    quiet = {"figures": False, "advice": 0}
    options = resolve_options(TrainingOptions, "ea").model_copy(update=quiet)
    for rate in given.false_alarm:
        with torch.no_grad():
            seen = Seen(Dataset(opened(given.recording)), options, rate)
            print(f"false alarm {rate:g}: {compared(seen)}")
            for grown in GROWN:
                print("  " + around_the_board(seen, grown))


if __name__ == "__main__":
    main()
