"""Draw the README's picture of a real arm: a sensor of one ray before four walls, on two mounts.

The data are the trials of Sifferman et al. (2022), `wall_trials_l3cx`. Nobody measured the walls or
where the sensor sits. Each mount is calibrated before all walls together, before each wall alone,
and before every three walls, to predict the distances to the fourth. Beside the errors of these
predictions stands what bounds them: what fits leave in the walls that they were fitted to, and how
well the readings at a pose repeat.
"""

import json
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import click
import numpy as np

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from tofcorr import Recording
    from tofcorr.fit.problem import Fit

MOUNTS = {"P1": "mount 1", "P2": "mount 2"}
WALLS = {"R1": "wall 1", "R2": "wall 2", "W1": "wall 3", "W2": "wall 4"}
COLOURS = {"P1": "tab:blue", "P2": "tab:orange"}
# Degree of the distance term: a line for the origin, which 32 poses before one wall must determine,
# and a parabola for predictions, which 96 poses before three walls determine. Chosen.
_LINE, _PARABOLA = 1, 2
# Standard errors within which the origin of a wall alone repeats that of all walls together.
_REPEATS = 2.0


@dataclass(frozen=True)
class Origin:
    """Where a fit puts the sensor: origin (3,) and covariance (3, 3) in mm, and ray, tool frame."""

    place: np.ndarray
    covariance: np.ndarray
    ray: np.ndarray
    undetermined: tuple[str, ...]

    def error(self, axis: np.ndarray) -> float:
        """Return the standard error along an axis, but for what a shift along the ray changes."""
        across = axis - (axis @ self.ray) * self.ray
        return float(np.sqrt(across @ self.covariance @ across))

    def apart(self, other: "Origin") -> np.ndarray:
        """Return the way from another origin to this one, moved along the ray, shape (3,).

        A shift along the ray is a constant error of the distance, and is not compared.
        """
        way = self.place - other.place
        return way - self.ray * (way @ other.ray) / (self.ray @ other.ray)

    def to_mapping(self) -> dict[str, Any]:
        """Return plain values, for JSON."""
        return {
            "origin_mm": self.place.round(2).tolist(),
            "se_mm": np.sqrt(np.diag(self.covariance)).round(2).tolist(),
            "ray": self.ray.round(4).tolist(),
            "not_determined": list(self.undetermined),
        }


@click.command()
@click.option("--data", required=True, type=click.Path(exists=True, path_type=Path))
@click.option("--out", required=True, type=click.Path(path_type=Path), help="The PNG.")
def command(data: Path, out: Path) -> None:
    """Fit the trials in DATA, print what was found as JSON, and draw it to OUT."""
    with TemporaryDirectory() as folder:
        found = {mount: _fitted_mount(data, mount, Path(folder)) for mount in MOUNTS}
    scores = [score for one in found.values() for score in one["scores"]]
    printed: dict[str, Any] = {
        mount: {
            "together": one["together"].to_mapping(),
            "alone": {wall: origin.to_mapping() for wall, origin in one["alone"].items()},
            **one["errors_mm"],
        }
        for mount, one in found.items()
    }
    printed["repeats"] = f"{sum(abs(s) <= _REPEATS for s in scores)} of {len(scores)} within 2 SE"
    click.echo(json.dumps(printed, indent=1))
    _drawn(found).savefig(out, dpi=110)


def _fitted_mount(data: Path, mount: str, folder: Path) -> dict[str, Any]:
    recording = _imported(data, mount, tuple(WALLS), folder)
    together = _origin(_fit(recording, _LINE))
    singly = {wall: _imported(data, mount, (wall,), folder) for wall in WALLS}
    alone = {wall: _origin(_fit(one, _LINE)) for wall, one in singly.items()}
    scores = [
        float(one.apart(together) @ axis / np.hypot(one.error(axis), together.error(axis)))
        for one in alone.values()
        for axis in np.eye(3)[:2]
    ]
    errors: dict[str, dict[str, float]] = {}
    for wall, one in singly.items():
        others = recording.frames.target != wall
        found = {
            "held_out_rms_mm": _rms(recording, wall, others),
            "fitted_rms_mm": _rms(recording, wall, others | True),
            "fitted_alone_rms_mm": _rms(one, wall, np.ones(one.num_frames, dtype=bool)),
            "repeat_rms_mm": _repeats(data / f"L3CX_{wall}_{mount}" / "measurements.csv"),
        }
        for name, value in found.items():
            errors.setdefault(name, {})[wall] = round(value, 2)
    return {"together": together, "alone": alone, "scores": scores, "errors_mm": errors}


def _imported(data: Path, mount: str, walls: tuple[str, ...], folder: Path) -> "Recording":
    """Import as `tofcorr import distances` does."""
    from tofcorr import Recording
    from tofcorr.importing.distances import command as distances

    out = folder / "_".join((mount, *walls))
    sources = [str(data / f"L3CX_{wall}_{mount}") for wall in walls]
    names = [word for wall in walls for word in ("--wall", wall)]
    arguments = [*sources, *names, "--depth-unit-mm", "1", "--out", str(out)]
    distances.main(arguments, standalone_mode=False)
    return Recording.open(out)


def _fit(recording: "Recording", degree: int, frames: np.ndarray | None = None) -> "Fit":
    from tofcorr.fit.fitting import fit
    from tofcorr.pixels.dataset import Dataset
    from tofcorr.pixels.lattice import covered_domain
    from tofcorr.training.calibration import TrainingOptions

    terms = [{"kind": "distance_polynomial", "degree": degree}]
    options = TrainingOptions.from_mapping({"name": "D", "model": {"terms": terms}}, "trials")
    data = Dataset((recording,))
    everything = np.arange(data.num_frames)
    chosen = everything if frames is None else frames
    return fit(data, chosen, options, covered_domain(data, everything))


def _origin(result: "Fit") -> Origin:
    transform = result.solution.parameters.tool_from_camera.numpy()
    rotation = transform[:3, :3]
    covariance = rotation @ result.covariance.matrix[:3, :3].numpy() @ rotation.T
    undetermined = tuple(one.in_words() for one in result.observability.undetermined)
    return Origin(1e3 * transform[:3, 3], 1e6 * covariance, rotation[:, 2], undetermined)


def _rms(recording: "Recording", wall: str, fitted: np.ndarray) -> float:
    """Fit these frames (N,); estimate a wall's plane alone; return its distances' RMS, mm."""
    from tofcorr.fit.walls import walls_alone
    from tofcorr.pixels.dataset import Dataset
    from tofcorr.pixels.passes import frame_errors

    data = Dataset((recording,))
    seen = np.flatnonzero(data.targets == wall)
    model = _fit(recording, _PARABOLA, np.flatnonzero(fitted)).model
    data = walls_alone(data, seen, model).put_into(data)
    return frame_errors(data, {"after": model})["after"]["to_plane"].rms_mm(seen)


def _repeats(path: Path) -> float:
    """Return the root mean square error of a median, mm: half of how far those of halves differ.

    Readings that follow each other are alike: one divided by the root of their number is too small.
    """
    differences = []
    for line in path.read_text().splitlines():
        readings = [float(cell) for cell in line.split(",")[1:] if cell.strip()]
        halves = readings[: len(readings) // 2], readings[len(readings) // 2 :]
        differences += [np.median(halves[0]) - np.median(halves[1])] if readings else []
    return float(np.sqrt(np.mean(np.square(differences))) / 2)


def _drawn(found: dict[str, dict[str, Any]]) -> "Figure":
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12, 3.9), layout="constrained")
    bars, *panels = figure.subplots(1, 3, width_ratios=(1.2, 1, 1))
    places = np.arange(len(WALLS))
    for shift, (mount, name) in zip((-0.2, 0.2), MOUNTS.items(), strict=True):
        values = list(found[mount]["errors_mm"]["held_out_rms_mm"].values())
        drawn = bars.bar(places + shift, values, width=0.38, color=COLOURS[mount], label=name)
        bars.bar_label(drawn, fmt="%.2f", fontsize=8)
    bars.set_xticks(places, list(WALLS.values()))
    bars.set_ylim(0, 2.4)
    bars.set_ylabel("RMS error, mm")
    bars.set_title("Distances to a wall that was not fitted\n(fitted to the other three)", size=10)
    bars.legend(loc="upper left", ncols=2, fontsize=8)
    for axes, mount in zip(panels, MOUNTS, strict=True):
        _draw_origins(axes, mount, found[mount])
    return figure


def _draw_origins(axes: "Axes", mount: str, found: dict[str, Any]) -> None:
    """Draw the origins of the walls alone around that of all walls together, and their errors."""
    together: Origin = found["together"]
    x, y = np.eye(3)[:2]
    label = "each wall alone"
    for wall, one in found["alone"].items():
        way, errors = one.apart(together), {"xerr": one.error(x), "yerr": one.error(y)}
        axes.errorbar(*way[:2], **errors, fmt="o", color="0.55", capsize=2, label=label)
        axes.annotate(WALLS[wall], way[:2], (6, 6), textcoords="offset points", fontsize=8)
        label = ""
    errors = {"xerr": together.error(x), "yerr": together.error(y)}
    style = {"fmt": "s", "color": COLOURS[mount], "capsize": 3, "elinewidth": 2.5}
    axes.errorbar(0, 0, **errors, **style, label="four walls together", zorder=3)
    axes.set_xlabel("along x of the tool, mm")
    axes.set_ylabel("along y of the tool, mm")
    title = f"Where the sensor sits, {MOUNTS[mount]}"
    axes.set_title(f"{title}\n(bars: one standard error)", size=10)
    axes.axis("equal")
    axes.grid(alpha=0.25)
    axes.legend(fontsize=8, loc="best")


if __name__ == "__main__":
    command()
