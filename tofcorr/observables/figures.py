"""Figures of noise, missing pixels and amplitude: recording red, simulator blue."""

from collections.abc import Callable
from functools import partial

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from tofcorr.estimation.robust import without_strays
from tofcorr.observables.compare import Observables
from tofcorr.observables.measure import LEAST_VARIANCE, DropoutMeasurement, NoiseMeasurement
from tofcorr.observables.pairs import Interval, Pair
from tofcorr.observables.read import log_of
from tofcorr.pages.drawing import (
    BLUE,
    FAINT,
    GREY,
    RED,
    SIGNED,
    WIDTH,
    image_map,
    line_across,
    panels,
    plain_look,
    plain_numbers,
)
from tofcorr.training.figures import profile, tile_means


def drawings(observables: Observables) -> dict[str, Callable[[], Figure]]:
    """Return what draws each figure that the findings allow, by its name on the report page."""
    found = {
        "noise": partial(noise_figure, observables),
        "dropouts": partial(dropout_figure, observables),
    }
    if observables.amplitude is not None and observables.amplitude["same_poses"]:
        found["amplitude"] = partial(amplitude_figure, observables)
    return found


def noise_figure(observables: Observables) -> Figure:
    """Draw the temporal noise over amplitude or distance, and the ratio of real to simulated.

    At the same poses, both are drawn over the amplitude of the recording, pixel by pixel.
    """
    both, compared = observables.both, observables.noise or {"ratio": None}
    real, sim = observables.noises or (observables.real_noise, None)
    ratio = compared["ratio"]  # A simulator without noise has none.
    figure, found = panels(4 if ratio is None else 5, 1 if ratio is None else 2)
    at = _brightness(real)
    ends = _log_ends(at)
    middle, sigma = _noise_points(found[0], at, real.variance, ends, (RED, "recording"))
    _noise_curve(found[0], real, ends, 1.0, RED)
    if sim is not None and both is not None:
        place, variance, scale = _brightness(sim), sim.variance, 1.0
        if both.paired:
            place, variance = at[both.rows], sim.variance[both.columns]
            scale = 1.0 / (observables.amplitude or {"ratio": 1.0})["ratio"]
        _, simulated = _noise_points(found[0], place, variance, ends, (BLUE, "simulator"))
        if sim.curve.needs_amplitude == real.curve.needs_amplitude:
            _noise_curve(found[0], sim, ends, scale, BLUE)
        if ratio is not None:
            found[1].semilogx(middle, sigma / simulated, "o", color=GREY)
            line_across(found[1], at=1.0)
            found[1].axhline(ratio, color=RED, linewidth=1)
            if compared["ratio_ci"] is not None:
                found[1].axhspan(*compared["ratio_ci"], color=RED, alpha=FAINT, linewidth=0)
            found[1].set_ylabel("recording / simulator\n(band: all, 95 %)")
            found[1].set_xlim(found[0].get_xlim())
    found[0].set_ylabel("noise of a pixel, mm")
    found[-1].set_xlabel("amplitude, counts" if real.curve.needs_amplitude else "distance, m")
    found[0].legend(frameon=False)
    for axis in (found[0].yaxis, *(axes.xaxis for axes in found)):
        plain_numbers(axis)
    return figure


def _noise_points(
    axes: Axes, at: np.ndarray, variance: np.ndarray, ends: Interval, look: tuple[str, str]
) -> Pair:
    """Draw the noise in bins.

    Returns:
        Middles of the bins, and the noise in them, mm; NaN with too few pixels or without noise.
    """
    middle, mean, _ = profile(log_of(at), variance, ends)
    sigma = 1e3 * np.sqrt(np.where(mean > LEAST_VARIANCE, mean, np.nan))
    axes.loglog(np.exp(middle), sigma, "o", color=look[0], markersize=5, label=look[1])
    return np.exp(middle), sigma


def _noise_curve(
    axes: Axes, noise: NoiseMeasurement, ends: Interval, scale: float, colour: str
) -> None:
    """Draw the fitted curve, its amplitude being `scale` times that of the axis."""
    line = np.exp(np.linspace(*ends, 100))
    sigma = noise.curve.temporal_sigma(line, scale * line)
    if float(sigma.max()) ** 2 > LEAST_VARIANCE:
        axes.plot(line, 1e3 * sigma, color=colour)


def _brightness(noise: NoiseMeasurement) -> np.ndarray:
    table = noise.observed.table
    return table.amplitude if noise.curve.needs_amplitude else table.distance


def dropout_figure(observables: Observables) -> Figure:
    """Draw the share of missing pixels over the amplitude, and over the image."""
    real, sim = observables.real_dropouts, observables.sim_dropouts
    shown = [("recording", real, RED, real.share)]
    if sim is not None and observables.dropouts is not None:
        # Two recordings are compared over the pixels of both: the shares that the report states.
        shares = observables.dropouts["real_share"], observables.dropouts["sim_share"]
        shown = [("recording", real, RED, shares[0]), ("simulator", sim, BLUE, shares[1])]
    with_amplitude = any(np.isfinite(each.amplitude).any() for _, each, *_ in shown)
    # The maps stand below the curves, so that the words can be read on a narrow page too.
    figure = Figure(figsize=(WIDTH, 5 if with_amplitude else 2), layout="constrained")
    parts = figure.subfigures(1 + with_amplitude, 1, squeeze=False).ravel().tolist()
    if with_amplitude:
        axes = parts[0].subplots()
        plain_look(axes)
        for name, dropouts, colour, _ in shown:
            _dropout_curve(axes, dropouts, colour, name)
        axes.set_ylabel("pixels without distance, %")
        axes.set_xlabel("amplitude, counts")
        axes.set_ylim(bottom=0.0)
        axes.legend(frameon=False)
        plain_numbers(axes.xaxis)
    highest = max(100 * float(np.nanmax(each.map)) for _, each, *_ in shown) or 1.0
    maps = parts[-1].subplots(1, len(shown), squeeze=False)[0]
    for axes, (name, dropouts, _, share) in zip(maps, shown, strict=True):
        image_map(axes, 100 * dropouts.map, "missing, %", (0.0, highest), "magma_r")
        axes.set_title(f"{name}: {100 * share:.2f} % missing", fontsize=9)
    return figure


def _dropout_curve(axes: Axes, dropouts: DropoutMeasurement, colour: str, name: str) -> None:
    table, at = dropouts.observed.table, dropouts.amplitude
    if not np.nan_to_num(at).any():
        return
    ends = _log_ends(at)
    middle, share, _ = profile(log_of(at), 100 * table.missing / table.frames, ends)
    axes.semilogx(np.exp(middle), share, "o", color=colour, markersize=4, label=name)
    line = np.exp(np.linspace(*ends, 200))
    axes.plot(line, 100 * dropouts.model.probability(line), color=colour)


def amplitude_figure(observables: Observables) -> Figure:
    """Draw real over simulated amplitude, and their ratio over the image; the same poses only."""
    both, compared = observables.both, observables.amplitude
    assert both is not None
    assert compared is not None
    lit = (np.nan_to_num(both.real.amplitude) > 0) & (np.nan_to_num(both.sim.amplitude) > 0)
    real, sim, ratio = both.real.amplitude[lit], both.sim.amplitude[lit], compared["ratio"]
    figure, (upper, lower) = panels(6, 2)
    upper.hexbin(sim, real, xscale="log", yscale="log", gridsize=45, cmap="Greys", bins="log")
    ends = np.array([sim.min(), sim.max()])
    upper.plot(ends, ends, color="black", linewidth=1, label="equal")
    upper.plot(ends, ratio * ends, color=RED, label=f"ratio {ratio:.3g}")
    upper.set_xlabel("simulated amplitude, counts")
    upper.set_ylabel("recorded amplitude, counts")
    upper.legend(frameon=False)
    for axis in (upper.xaxis, upper.yaxis):
        plain_numbers(axis)
    shape = observables.real_dropouts.map.shape
    tiles = 100 * np.expm1(tile_means(both.real.pixel[lit], np.log(real / sim / ratio), shape))
    limit = max(float(np.nanmax(np.abs(tiles))), 1.0)
    image_map(lower, tiles, "recording brighter, %", (-limit, limit), SIGNED)
    lower.set_title("ratio over the image, less its mean", fontsize=10)
    return figure


def _log_ends(values: np.ndarray) -> Interval:
    """Return the range of the logarithms of some values, without stray ones."""
    logs = log_of(values)
    low, high = without_strays(logs[np.isfinite(logs)]) if np.isfinite(logs).any() else (0.0, 0.0)
    return low, high if high > low else low + 1
