"""How many poses a live calibration needs: by its advice, at random, and over a grid.

    python -m benchmarks.live_poses --seed 1 --count 20

Cells of one wall that nobody measured, a robot of 0.05 mm and 0.05 mrad, a camera of 64 x 50 pixels
with 3 mm of noise and an error of distance and place in the image. All ways have the same limits of
distance, tilt and roll, start with the same four poses and end when `Known.enough` says so, or
after 60 poses. The truth never enters.
"""

import itertools
import math

import click
import numpy as np
import torch

from tofcorr.geometry import se3
from tofcorr.geometry.camera import CameraIntrinsics
from tofcorr.geometry.rays import plane_in_frame, ray_directions, ray_plane_distance
from tofcorr.live.calibration import Known, LiveCalibration
from tofcorr.training.advice import PosePool, Workspace, draw_views

CAMERA = CameraIntrinsics(
    width=64, height=50, matrix=((60.0, 0.0, 31.5), (0.0, 60.0, 24.5), (0.0, 0.0, 1.0))
)
CONFIG = {
    "name": "live",
    "model": {
        "terms": [
            {"kind": "distance_polynomial", "degree": 3},
            {"kind": "pixel_polynomial", "degree": 2},
        ]
    },
}
SPACE = Workspace(nearest=0.6, farthest=1.6, tilt_deg=35.0, roll_deg=90.0)
MOST = 60


class Cell:
    """A robot, a wall and a camera, drawn at random."""

    def __init__(self, seed: int) -> None:
        self.random = np.random.default_rng(seed)
        turn = self.random.normal(0, 0.05, 3)
        self.hand_eye = se3.exp(torch.tensor([0.05, -0.02, 0.12, *turn], dtype=torch.float64))
        self.rays = ray_directions(CAMERA)
        start = torch.eye(4, dtype=torch.float64)
        self.wall = torch.tensor([[0.0, 0.0, -1.0]]).double(), torch.tensor([1.1]).double()
        generator, light = np.random.default_rng(seed + 1), {"wall": torch.zeros(2).double()}
        pool = draw_views(start[None], self.wall, self.hand_eye, SPACE, light, self.rays, generator)
        assert pool is not None
        self.pool: PosePool = pool
        self.errors = self.random.normal(0, [0.015, 0.01, 0.005, 0.005, 0.005])

    def add(self, live: LiveCalibration, pose: np.ndarray, random: np.random.Generator) -> Known:
        """Record a frame where the robot says `pose`, and add it."""
        off = random.normal(0, [5e-5] * 6)
        true = torch.from_numpy(pose) @ se3.exp(torch.from_numpy(off)) @ self.hand_eye
        plane = plane_in_frame(self.wall[0], self.wall[1], true[None])
        distance = ray_plane_distance(self.rays, *plane)[0].numpy()
        rows, columns = np.mgrid[-1 : 1 : CAMERA.height * 1j, -1 : 1 : CAMERA.width * 1j]
        functions = 1, distance - 1, (distance - 1) ** 2, rows, columns**2
        error = sum(own * part for own, part in zip(self.errors, functions, strict=True))
        noise = random.normal(0, 3e-3, distance.shape)
        return live.add((distance + error + noise).astype(np.float32), None, pose)

    def is_reachable(self, pose: np.ndarray) -> bool:
        """Whether the camera is rolled from the start by no more than the random poses are."""
        turn = (torch.from_numpy(pose) @ self.hand_eye)[:2, :2]
        roll = torch.atan2(turn[1, 0] - turn[0, 1], turn[0, 0] + turn[1, 1])
        return abs(math.degrees(roll)) <= SPACE.roll_deg

    def poses_needed(self, way: str) -> tuple[int, float, float]:
        """Return how many poses are enough, and how far off the hand-eye then is, mm, degrees."""
        random = np.random.default_rng(self.random.bit_generator.seed_seq.entropy)  # type: ignore[attr-defined]
        guess = self.hand_eye.numpy()
        live = LiveCalibration(CAMERA, CONFIG, tool_from_camera=guess, space=SPACE)
        order = random.permutation(len(self.pool.target))
        if way == "grid":
            order = np.concatenate([order[:4], self.grid()])
        known, taken = None, 0
        while taken < MOST and not (known is not None and known.enough):
            pose = None
            if way == "advice" and taken >= 4:
                pose = live.next_pose(self.is_reachable, seed=taken)
            if pose is None:
                pose = self.pool.world_from_tool[order[taken % len(order)]].numpy()
            known, taken = self.add(live, pose, random), taken + 1
        found = live.result().solution.parameters.tool_from_camera
        shift, turn = se3.apart(found, self.hand_eye)
        return taken, 1e3 * shift, float(np.degrees(turn))

    def grid(self) -> np.ndarray:
        """Return the poses of the pool that are nearest to the nodes of a grid."""
        nodes = list(
            itertools.product([0.6, 1.1, 1.6], [10.0, 25.0, 35.0], [-80.0, -27.0, 27.0, 80.0])
        )
        scale = np.array([1.0, 35.0, 90.0])
        apart = (self.pool.described.numpy()[:, None] - np.array(nodes)) / scale
        return np.linalg.norm(apart, axis=2).argmin(axis=0)


@click.command()
@click.option("--seed", default=1, show_default=True)
@click.option("--count", default=20, show_default=True, help="Cells.")
def main(seed: int, count: int) -> None:
    """Print how many poses each way needs: median, worst, and how far off the hand-eye is then."""
    found = {
        way: np.array([Cell(1000 * seed + k).poses_needed(way) for k in range(count)])
        for way in ("advice", "random", "grid")
    }
    for way, each in found.items():
        poses, shift, turn = each.T
        inside = np.mean((shift <= 0.5) & (turn <= 0.05))
        size = f"off {np.median(shift):.2f} mm, {np.median(turn):.3f} deg; within {inside:.0%}"
        print(f"{way:7} median {np.median(poses):.0f}, worst {poses.max():.0f} poses; {size}")
    ratio = found["advice"][:, 0] / found["random"][:, 0]
    print(f"advice needs {np.median(ratio):.2f} of the random poses (median of {count} cells)")


if __name__ == "__main__":
    main()
