"""A real arm, pose by pose: how its held-out error falls as poses are added.

    python -m benchmarks.real_arm --data wall_trials_l3cx --seed 1

A sensor of one ray on two mounts, 32 poses before each of four walls that nobody measured
(Sifferman et al. 2022). Every fourth pose of a trial is held out. D is fitted to the first of the
others in three orders: as they were recorded, at random, and by advice: each pose is the one that
the calibration so far expects to tell most, by what `tofcorr` advises. All begin with the same four
poses. The start of every fit is the import's, which looked at all poses.
"""

import tempfile
from pathlib import Path

import click
import numpy as np
import torch

from benchmarks.sealed.scores import table
from tofcorr.data.recording import Recording
from tofcorr.estimation.planes import Walls, joint_image_equations
from tofcorr.fit.fitting import fit
from tofcorr.fit.problem import Fit
from tofcorr.fit.walls import with_every_wall
from tofcorr.importing.distances import command as distances
from tofcorr.options import resolve_options
from tofcorr.pixels.dataset import Dataset
from tofcorr.pixels.lattice import covered_domain
from tofcorr.pixels.passes import frame_errors
from tofcorr.training.advice import choose_views
from tofcorr.training.calibration import TrainingOptions

POSES = (6, 8, 10, 12, 16, 24)
FIRST = 4
ORDERS = 4  # random ones, of which the mean square is taken


class Trial:
    """The poses of one mount before one wall."""

    def __init__(self, source: Path, out: Path) -> None:
        words = [str(source), "--depth-unit-mm", "1", "--out", str(out)]
        distances.main(words, standalone_mode=False)
        self.data = Dataset((Recording.open(out),))
        frames = np.arange(self.data.num_frames)
        self.held_out = frames[3::4]
        self.others = np.setdiff1d(frames, self.held_out)
        self.domain = covered_domain(self.data, frames)
        terms = [{"kind": "distance_polynomial", "degree": 1}]
        options = {"name": "D", "model": {"terms": terms}, "planes": "unknown"}
        self.options = resolve_options(TrainingOptions, options)

    def fit(self, frames: np.ndarray) -> Fit:
        """Fit some poses."""
        return fit(self.data, np.sort(frames), self.options, self.domain)

    def error(self, frames: np.ndarray) -> float:
        """Return the RMS distance of the held-out readings to the wall, mm, fitted to others."""
        found = self.fit(frames)
        data = with_every_wall(self.data, found.walls, found.model)
        errors = frame_errors(data, {"after": found.model})["after"]["to_plane"]
        return errors.rms_mm(self.held_out)

    def by_advice(self, start: np.ndarray) -> np.ndarray:
        """Return the poses in the order in which each is expected to tell most."""
        chosen, seen = np.searchsorted(self.others, start), self.fit(self.others).moments
        poses = self.data.column("world_from_tool")[self.others]
        while len(chosen) < len(self.others):
            found = self.fit(self.others[chosen])
            assert found.walls is not None  # One wall, which every pose shows.
            wall = found.walls.walls
            walls = Walls(wall.normal_world, wall.offset, torch.zeros(len(poses)).long(), poses)
            equations = joint_image_equations(walls.seen_by(seen), found.optimum, walls)
            precision = equations.hessian / found.observability.variance
            left = np.setdiff1d(np.arange(len(poses)), chosen)
            (best,), _ = choose_views(precision[chosen].sum(dim=0), precision[left], 1)
            chosen = np.append(chosen, left[best])
        return self.others[chosen]

    def errors(self, random: np.random.Generator) -> dict[str, np.ndarray]:
        """Return the error of each way after each number of poses, mm."""
        first, later = np.split(self.others, [FIRST])
        drawn = [np.append(first, random.permutation(later)) for _ in range(ORDERS)]
        ways = {"as recorded": [self.others], "at random": drawn}
        ways["by advice"] = [self.by_advice(first)]
        found = {
            way: np.array([[self.error(order[:number]) for number in POSES] for order in orders])
            for way, orders in ways.items()
        }
        return {way: np.sqrt(np.mean(np.square(each), axis=0)) for way, each in found.items()}


@click.command()
@click.option("--data", required=True, type=click.Path(exists=True, path_type=Path))
@click.option("--seed", type=int, required=True, help="Of the random orders.")
def main(data: Path, seed: int) -> None:
    """Print the held-out error of all trials after each number of poses."""
    torch.set_num_threads(1)
    random, found = np.random.default_rng(seed), list[dict[str, np.ndarray]]()
    with tempfile.TemporaryDirectory() as folder:
        for trial in sorted(data.glob("L3CX_*")):
            found.append(Trial(trial, Path(folder) / trial.name).errors(random))
    lines = []
    for place, number in enumerate(POSES):
        each = [np.array([one[way][place] for one in found]) for way in found[0]]
        lines.append((number, *(f"{np.median(one):.2f} ({one.max():.2f})" for one in each)))
    click.echo(table(("poses", *found[0]), lines))


if __name__ == "__main__":
    main()
