"""Does the stated uncertainty of a corrected pixel hold, in the light of scenes it has not seen?

    python -m benchmarks.scene_light.uncertainty --seed 1

`corrector.uncertainty` gives the standard deviation of each pixel of the scenes of
`benchmarks.scene_light.bounces`, with noise, after a calibration on walls of other seeds, and
of `benchmarks.scene_light.edges` with flying pixels. The error over it should be below 1 in 68.3
and below 2 in 95.4 percent of the pixels. Pixels that are not valid are left out.
"""

import argparse
import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import torch

import tofcorr
from benchmarks.scene_light import edges, rooms
from benchmarks.scene_light.bounces import OTHER_SEED, WALLS, Image
from benchmarks.scene_light.walls import QUIET, RUNTIME, recorded, seen
from tofcorr.correction.corrector import DepthCorrector
from tofcorr.correction.state import CalibrationState, SceneLight
from tofcorr.error_terms.base import Domain, Interval
from tofcorr.error_terms.model import ErrorModelOptions
from tofcorr.geometry.camera import CameraIntrinsics
from tofcorr.scene_light.flying import FlyingPixelsOptions
from tofcorr.training.scene import shown_by

LONE, LIT = 12, 2  # seeds of the walls of a calibration, one frame of each; two of each
NEAR = 0.15  # metres to another surface
STEP = 0.06  # from a pixel to the next, as a share of the distance: an edge
CLASSES = ("elsewhere", "near a corner", "edge")


def calibrated(seed: int) -> DepthCorrector:
    """Calibrate as a user does: on lone walls, and a few with a floor or a side wall in view."""
    first = LONE * seed  # No other seed has any of these walls.
    frames = [frame for k in range(LONE) for frame in rooms.rendered("lone_wall", first + k, 1)]
    for name in WALLS:
        frames += [frame for k in range(LIT) for frame in rooms.rendered(name, first + k, 2)]
    config = QUIET | {"runtime": RUNTIME, "split": {"test_fraction": 0.0}}
    with tempfile.TemporaryDirectory() as folder:
        recording = recorded(frames, seed, Path(folder) / "walls")
        return tofcorr.train(recording, config, force=True).corrector()


def class_of(frame: rooms.Frame) -> Image:
    """Numbers of `CLASSES` (H, W)."""
    from scipy.ndimage import maximum_filter, minimum_filter
    from scipy.spatial import KDTree

    distance, known = frame.distance, np.isfinite(frame.distance)
    far, near = np.where(known, distance, -np.inf), np.where(known, distance, np.inf)
    step = maximum_filter(far, 3) - minimum_filter(near, 3)
    result, places = np.zeros(distance.shape, int), distance[..., None] * rooms.rays()
    for number in np.unique(frame.shape[known]):
        own, others = frame.shape == number, known & (frame.shape != number)
        if others.any():
            result[own] = KDTree(places[others]).query(places[own])[0] < NEAR
    result[step > STEP * distance] = CLASSES.index("edge")
    return result


def normalised(correct: DepthCorrector, depth: Any, light: Any, truth: Image) -> Image:  # noqa: ANN401
    """Errors over their standard deviations (H, W); NaN where they are not valid."""
    corrected, valid = correct(depth, light)
    errors = (corrected.numpy() - truth) / correct.uncertainty(depth, light).numpy()
    return np.where(valid.numpy(), errors, np.nan)


def shares(name: str, errors: Iterable[Image]) -> str:
    """One line of the table."""
    every = np.abs(np.concatenate([image[np.isfinite(image)] for image in errors]))
    inside = "".join(f"{100 * np.mean(every < limit):9.1f}" for limit in (1, 2))
    return f"{name:24}{inside}{len(every):9}"


def of_edges(seed: int, count: int) -> None:
    """Print lines of boards and slats with flying pixels."""
    from scipy.ndimage import maximum_filter

    frames = {
        kind: [edges.frame_of(kind, seed + k, 0.35) for k in range(count)]
        for kind in ("boards", "slats")
    }
    every = [frame for own in frames.values() for frame in own]
    depth, light = (
        torch.tensor(np.stack([getattr(frame, name) for frame in every])).float()
        for name in ("distance", "amplitude")
    )
    view = CameraIntrinsics(width=edges.WIDTH, height=edges.HEIGHT, matrix=edges.matrix())
    shown = shown_by(depth, light, view, "radial", FlyingPixelsOptions())
    assert shown is not None, "the frames show flying pixels"
    domain = Domain(height=view.height, width=view.width, radial_distance=Interval(0.1, 7.0))
    state = CalibrationState(
        name="edges",
        camera=view,
        depth_kind="radial",
        domain=domain,
        error_model=ErrorModelOptions(terms=()),
        coefficients=torch.zeros(1).double(),
        covariance=torch.zeros(1, 1).double(),
        noise=shown.noise,
        tool_from_camera=torch.eye(4).double(),
        hand_eye_estimated=False,
        scene=SceneLight(flying_pixels=shown),
    )
    correct = DepthCorrector.from_state(state)
    for kind, own in frames.items():
        parts: dict[str, list[Image]] = {"beside flagged": [], "elsewhere": []}
        for frame in own:
            depth, light = (torch.tensor(x).float() for x in (frame.distance, frame.amplitude))
            errors = normalised(correct, depth, light, frame.truth)
            beside = np.asarray(maximum_filter(np.isnan(errors), 3), bool)
            for title, used in zip(parts, (beside, ~beside), strict=True):
                parts[title].append(errors[used])
        for title, found in parts.items():
            print(shares(f"{kind}: {title}", found))


@torch.no_grad()
def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, nargs="+", required=True)
    parser.add_argument("--views", type=int, default=4)
    parser.add_argument("--edges", type=int, default=6, help="frames with flying pixels")
    given = parser.parse_args()
    torch.set_num_threads(1)
    kinds: dict[str, list[Image]] = {name: [] for name in (*rooms.SCENES, *CLASSES)}
    for seed in given.seed:
        correct = calibrated(seed + OTHER_SEED)
        for name in rooms.SCENES:
            draw = np.random.default_rng(seed + 1)
            for frame in rooms.rendered(name, seed, given.views):
                errors = normalised(correct, *seen(frame, draw), frame.distance)
                kinds[name].append(errors)
                classes = class_of(frame)
                for number, title in enumerate(CLASSES):
                    kinds[title].append(errors[classes == number])
    print(f"{'':24}{'1 sigma':>9}{'2 sigma':>9}{'pixels':>9}")
    for title, found in kinds.items():
        print(shares(title, found))
    print(shares("all", (image for name in rooms.SCENES for image in kinds[name])))
    of_edges(given.seed[0], given.edges)


if __name__ == "__main__":
    main()
