"""Draw the pictures of docs/how-to/robot-and-wall.md: planned poses, a wall before and after."""

import csv
from pathlib import Path
from typing import TYPE_CHECKING

import click
import numpy as np

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Length of the line that shows where a camera looks, metres.
_ARROW = 0.15


@click.command()
@click.option("--poses", required=True, type=click.Path(path_type=Path), help="Of `tofcorr poses`.")
@click.option("--run", required=True, type=click.Path(path_type=Path), help="Of `tofcorr train`.")
@click.option("--recording", required=True, type=click.Path(path_type=Path))
@click.option("--out", required=True, type=click.Path(path_type=Path), help="Folder of the PNGs.")
def command(poses: Path, run: Path, recording: Path, out: Path) -> None:
    """Draw OUT/robot-poses.png and OUT/robot-wall.png."""
    draw_poses(poses).savefig(out / "robot-poses.png", dpi=90)
    draw_wall(run, recording).savefig(out / "robot-wall.png", dpi=90)


def draw_poses(path: Path) -> "Figure":
    """Draw where the cameras stand, from above and from the side; relative poses of a file."""
    from matplotlib.figure import Figure
    from scipy.spatial.transform import Rotation

    with path.open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    positions = np.array([[float(row[name]) for name in ("tx", "ty", "tz")] for row in rows])
    turns = [[float(row[name]) for name in ("qx", "qy", "qz", "qw")] for row in rows]
    forward = Rotation.from_quat(turns).as_matrix()[:, :, 2]
    wall = float((positions[:, 2] + [float(row["distance_m"]) for row in rows] * forward[:, 2])[0])
    figure = Figure(figsize=(9, 3.6), layout="constrained")
    for axes, across, name in zip(
        figure.subplots(1, 2), (0, 1), ("above", "the side"), strict=True
    ):
        _draw_cameras(axes, positions[:, [2, across]], forward[:, [2, across]])
        axes.axvline(wall, color="0.4", linewidth=4, solid_capstyle="butt")
        axes.set_title(f"from {name}", fontsize=10)
        axes.set_xlabel("towards the wall, m")
        axes.set_ylabel(("right, m", "down, m")[across])
        axes.set_aspect("equal")
        axes.grid(alpha=0.25)
    figure.suptitle(f"{len(rows)} planned poses; numbers: the order of their value", fontsize=11)
    return figure


def _draw_cameras(axes: "Axes", positions: np.ndarray, forward: np.ndarray) -> None:
    for number, (place, way) in enumerate(zip(positions, forward, strict=True), start=1):
        axes.plot(*np.stack([place, place + _ARROW * way]).T, color="tab:blue", linewidth=1.2)
        axes.plot(*place, "o", color="tab:blue", markersize=3)
        axes.annotate(str(number), place, (-4, 3), textcoords="offset points", fontsize=7)


def draw_wall(run: Path, path: Path) -> "Figure":
    """Draw the distance of one held-out frame's points from the wall, before and after."""
    import json

    import torch
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize
    from matplotlib.figure import Figure

    from tofcorr import DepthCorrection, Recording

    module, recording = DepthCorrection.load(run), Recording.open(path)
    report = json.loads((run / "report.json").read_text(encoding="utf-8"))
    frame = report["frames"]["test"][0]
    table = recording.frames
    depth = torch.from_numpy(recording.depth[frame].astype(np.float64))
    amplitude = torch.tensor(recording.require("amplitude", "the picture")[frame]).double()
    world_from_tool = torch.from_numpy(table.world_from_tool[frame])
    normal, offset = torch.from_numpy(table.normal_world[frame]), torch.tensor(table.offset[frame])
    after = module.points_tool(depth, amplitude).detach()
    rays = module.geometry.points(depth).detach()
    images = {}
    hand_eye = module.hand_eye().detach()
    for name, points in (
        ("measured", rays @ hand_eye[:3, :3].T + hand_eye[:3, 3]),
        ("corrected", after),
    ):
        world = points @ world_from_tool[:3, :3].T + world_from_tool[:3, 3]
        images[name] = 1e3 * (world @ normal + offset).numpy()
    limit = float(np.nanquantile(np.abs(images["measured"]), 0.98))
    figure = Figure(figsize=(9, 3.2), layout="constrained")
    panels = figure.subplots(1, 2)
    scale = ScalarMappable(Normalize(-limit, limit), "RdBu")
    for axes, (name, image) in zip(panels, images.items(), strict=True):
        axes.imshow(image, cmap=scale.cmap, norm=scale.norm)
        axes.set_title(f"{name}: RMS {np.sqrt(np.nanmean(image**2)):.1f} mm", fontsize=10)
        axes.set_xticks([])
        axes.set_yticks([])
    figure.colorbar(scale, ax=panels, label="distance from the wall, mm", shrink=0.9)
    figure.suptitle(f"Held-out frame {frame} of the demonstration, with its hand-eye", fontsize=11)
    return figure


if __name__ == "__main__":
    command()
