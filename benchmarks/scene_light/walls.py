"""How right is a base error that is fitted to walls with a floor in view, rendered?

    python -m benchmarks.scene_light.walls --seed 1

A recording holds walls with the floor mostly outside of the image. It is fitted with second bounces
in the frames, and without. Both correct walls of another seed; second bounces are removed with the
same gain.
"""

import argparse
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

import tofcorr
from benchmarks.scene_light import rooms
from benchmarks.scene_light.bounces import Image, base_error, camera
from tofcorr.correction.corrector import DepthCorrector
from tofcorr.data.table import FrameRow
from tofcorr.data.writing import write_recording
from tofcorr.training.run import calibration_state

HELD_OUT = 7  # what is added for the seed of the walls that are corrected
VARIANCE = 3.5e-3**2 * 300  # square metres times counts: 3.5 mm at 300 counts
LOG = {"kind": "amplitude_polynomial", "variable": "log_amplitude", "degree": 1}
TERMS = [{"kind": "distance_polynomial", "degree": 5}, LOG]
QUIET: dict[str, Any] = {"name": "walls", "model": {"terms": TERMS}, "figures": False, "advice": 0}
RUNTIME = {"second_bounces": {"light_half_angle_deg": rooms.CONE}}


def seen(
    frame: rooms.Frame, draw: np.random.Generator | None = None
) -> tuple[torch.Tensor, torch.Tensor]:
    """Distance and amplitude (H, W) as the camera gives them; None: without noise."""
    amplitude = frame.amplitude * abs(1 + frame.ratio)
    noise = np.sqrt(VARIANCE / amplitude) * (draw.normal(size=amplitude.shape) if draw else 0.0)
    distance = frame.distance + frame.error + base_error(frame.distance + frame.error, amplitude)
    return torch.tensor(distance + noise).float(), torch.tensor(amplitude).float()


def wall_of(frame: rooms.Frame) -> Image:
    """Where the largest surface is (H, W)."""
    return frame.shape == np.bincount(frame.shape[frame.shape >= 0]).argmax()


def recorded(frames: Sequence[rooms.Frame], seed: int, folder: Path) -> Path:
    """Write frames of walls, whose planes are known, with noise."""
    draw, rows, images = np.random.default_rng(seed), [], []
    for frame in frames:
        wall = wall_of(frame)
        normal = np.median(frame.normal[wall], axis=0)
        normal /= np.linalg.norm(normal)
        rows.append(
            FrameRow(
                timestamp=0.1 * len(rows),
                world_from_tool=np.eye(4),
                normal_world=normal,
                offset=float(-np.median(frame.distance[wall] * (rooms.rays()[wall] @ normal))),
                target="wall",
                pose_id=len(rows),
            )
        )
        images.append((*seen(frame, draw), torch.tensor(wall)))
    depth, light, mask = (torch.stack(each).numpy() for each in zip(*images, strict=True))
    write_recording(
        folder,
        camera=camera(),
        depth_kind="radial",
        rows=rows,
        modulation_frequency=rooms.FREQUENCY,
        tool_from_camera=np.eye(4),
        depth=depth,
        amplitude=light,
        mask=mask.astype(np.uint8),
    )
    return folder


@torch.no_grad()
def left(correct: DepthCorrector, name: str, seed: int) -> str:
    """Mean and root mean square of what is left on walls, millimetres."""
    errors = []
    for k, frame in enumerate(rooms.rendered(name, seed, 4)):
        corrected, valid = correct(*seen(frame, np.random.default_rng(seed + k)))
        used = valid.numpy() & wall_of(frame)
        errors.append(1e3 * (corrected.numpy() - frame.distance)[used])
    every = np.concatenate(errors)
    return f"{np.mean(every):8.1f}{np.sqrt(np.mean(every**2)):8.1f}"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--frames", type=int, default=16)
    given = parser.parse_args()
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        walls = rooms.rendered("wall_and_floor", given.seed, given.frames)
        recording = recorded(walls, given.seed, Path(folder) / "walls")
        with_them = tofcorr.train(recording, QUIET, force=True)
        without = tofcorr.train(recording, QUIET | {"runtime": RUNTIME}, force=True)
        states = [calibration_state(x.data, x.options, x.fit) for x in (with_them, without)]
        scene = states[1].scene
        assert scene.second_bounces is not None
        print(f"gain over the true one: {scene.second_bounces.gain * rooms.GAIN:.3f}")
        print(f"{'fitted with them: mean, RMS; without: mean, RMS':>64}")
        both = [DepthCorrector.from_state(x.model_copy(update={"scene": scene})) for x in states]
        for name in ("lone_wall", "wall_and_floor", "wall_and_side"):
            print(f"{name:24}" + "".join(left(x, name, given.seed + HELD_OUT) for x in both))


if __name__ == "__main__":
    main()
