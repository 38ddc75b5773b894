"""Figures of noise, missing pixels and amplitude: recording red, simulator blue.

Margins are set by hand: to fit them, a constrained layout draws each figure two more times.
"""

from collections.abc import Callable
from functools import partial

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from tofcorr.observables.compare import Observables
from tofcorr.observables.dropout_figure import dropout_figure
from tofcorr.observables.figure_parts import FEWEST, POINTS, binned, centres, plain, plain_numbers
from tofcorr.observables.models import LEAST_VARIANCE
from tofcorr.observables.noise import NoiseMeasurement
from tofcorr.observables.style import BLUE, GREY, RED, WIDTH

# Tiles along the longer side of the map of amplitude ratios: single pixels would show noise alone.
_TILES = 16


def all_figures(observables: Observables) -> dict[str, Figure]:
    """Return every figure that the findings allow, by its name on the report page."""
    return {name: draw() for name, draw in drawings(observables).items()}


def drawings(observables: Observables) -> dict[str, Callable[[], Figure]]:
    """Return what draws each of them."""
    found = {
        "noise": partial(noise_figure, observables),
        "dropouts": partial(dropout_figure, observables),
    }
    if observables.amplitude is not None and observables.amplitude.paired:
        found["amplitude"] = partial(amplitude_figure, observables)
    return found


def noise_figure(observables: Observables) -> Figure:
    """Draw the temporal noise over amplitude or distance, and the ratio of real to simulated.

    At the same poses, both are drawn over the amplitude of the recording, pixel by pixel.
    """
    compared, both = observables.noise, observables.both
    real = observables.real_noise if compared is None else compared.real
    # A simulator without noise has no ratio.
    height, rows = (3.6, 1) if compared is None or compared.ratio is None else (5.2, 2)
    figure = Figure(figsize=(WIDTH, height))
    figure.subplots_adjust(left=0.12, right=0.98, bottom=0.5 / height, top=0.98, hspace=0.08)
    panels = np.atleast_1d(figure.subplots(rows, 1, sharex=True, height_ratios=[3, 2][:rows]))
    at = _brightness(real)
    edges = _edges(at)
    sigma = _noise_points(panels[0], at, real.variance, edges, (RED, "recording"))
    _curve_line(panels[0], real, edges, 1.0, RED)
    if compared is not None and both is not None:
        sim = compared.sim
        place, variance, scale = _brightness(sim), sim.variance, 1.0
        if both.paired:
            place, variance = at[both.rows], sim.variance[both.columns]
            scale = 1.0 if observables.amplitude is None else 1.0 / observables.amplitude.ratio
        simulated = _noise_points(panels[0], place, variance, edges, (BLUE, "simulator"))
        _curve_line(panels[0], sim, edges, scale, BLUE, of=real)
        if compared.ratio is not None:
            panels[1].plot(centres(edges), sigma / simulated, "o", color=GREY)
            _ratio_band(panels[1], compared.ratio, compared.ratio_interval)
    panels[0].set_ylabel("noise of a pixel, mm")
    by_distance = real.curve.reference_amplitude is None
    panels[-1].set_xlabel("distance, m" if by_distance else "amplitude, counts")
    panels[0].legend(frameon=False)
    for axis in (panels[0].yaxis, panels[-1].xaxis):
        plain_numbers(axis)
    plain(panels)
    return figure


def _ratio_band(axes: Axes, ratio: float, interval: tuple[float, float] | None) -> None:
    axes.axhline(1.0, color="black", linewidth=0.8)
    axes.axhline(ratio, color=RED, linewidth=1)
    if interval is not None:
        axes.axhspan(*interval, color=RED, alpha=0.2, linewidth=0)
    axes.set_ylabel("recording / simulator\n(band: all, 95 %)")
    axes.set_ylim(bottom=0.0)


def amplitude_figure(observables: Observables) -> Figure:
    """Draw real over simulated amplitude, and their ratio over the image; the same poses only."""
    both, compared = observables.both, observables.amplitude
    assert both is not None
    assert compared is not None
    real, sim = both.real.amplitude, both.sim.amplitude
    use = np.isfinite(real) & np.isfinite(sim) & (real > 0) & (sim > 0)
    figure = Figure(figsize=(WIDTH, 5.8))
    figure.subplots_adjust(left=0.14, right=0.97, bottom=0.02, top=0.98, hspace=0.3)
    upper, lower = figure.subplots(2, 1)
    upper.hexbin(
        *(sim[use], real[use]), xscale="log", yscale="log", gridsize=45, cmap="Greys", bins="log"
    )
    ends = np.array([sim[use].min(), sim[use].max()])
    upper.plot(ends, ends, color="black", linewidth=0.8, label="equal")
    label = f"ratio {compared.ratio:.3g}"
    upper.plot(ends, compared.ratio * ends, color=RED, linewidth=1.2, label=label)
    upper.set_xlabel("simulated amplitude, counts")
    upper.set_ylabel("recorded amplitude, counts")
    upper.legend(frameon=False)
    for axis in (upper.xaxis, upper.yaxis):
        plain_numbers(axis)
    shape = observables.real_noise.observed.map_frames.shape
    ratio = np.log(real[use] / sim[use]) - np.log(compared.ratio)
    tiles = 100 * np.expm1(_tile_means(both.real.pixel[use], ratio, shape))
    limit = max(float(np.nanmax(np.abs(tiles))), 1.0)
    image = lower.imshow(tiles, cmap="RdBu_r", vmin=-limit, vmax=limit)
    lower.set_title("ratio over the image, less its mean", fontsize=10)
    lower.set_xticks([])
    lower.set_yticks([])
    figure.colorbar(image, ax=lower, shrink=0.9).set_label("recording brighter, %")
    plain([upper])
    return figure


def _noise_points(
    axes: Axes, at: np.ndarray, variance: np.ndarray, edges: np.ndarray, look: tuple[str, str]
) -> np.ndarray:
    """Draw the noise in bins; return it in mm, NaN in bins of too few pixels or without noise."""
    use = np.isfinite(at) & np.isfinite(variance)
    mean, count = binned(at[use], variance[use], edges)
    enough = (count >= FEWEST) & (np.nan_to_num(mean) > LEAST_VARIANCE)
    sigma = 1e3 * np.sqrt(np.where(enough, mean, np.nan))
    axes.plot(centres(edges), sigma, "o", color=look[0], markersize=5, label=look[1])
    axes.set_xscale("log")
    axes.set_yscale("log")
    return sigma


def _curve_line(
    axes: Axes,
    noise: NoiseMeasurement,
    edges: np.ndarray,
    scale: float,
    colour: str,
    of: NoiseMeasurement | None = None,
) -> None:
    """Draw the fitted curve, its amplitude being `scale` times that of the axis."""
    by_amplitude = noise.curve.reference_amplitude is not None
    drawn_over = noise if of is None else of
    if by_amplitude != (drawn_over.curve.reference_amplitude is not None):
        return
    line = np.geomspace(edges[0], edges[-1], 100)
    sigma = noise.curve.temporal_sigma(line, scale * line if by_amplitude else None)
    if float(sigma.max()) ** 2 > LEAST_VARIANCE:
        axes.plot(line, 1e3 * sigma, color=colour, linewidth=1.2)


def _brightness(noise: NoiseMeasurement) -> np.ndarray:
    table = noise.observed.table
    return table.distance if noise.curve.reference_amplitude is None else table.amplitude


def _edges(values: np.ndarray) -> np.ndarray:
    """Return bin edges, evenly spread in the logarithm over nearly all values."""
    known = values[np.isfinite(values) & (values > 0)]
    low, high = np.quantile(known, (0.002, 0.998)) if len(known) else (0.5, 2.0)
    return np.geomspace(low, max(high, 1.01 * low), POINTS + 1)


def _tile_means(pixel: np.ndarray, values: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Return the mean of values in tiles of the image."""
    side = max(1, max(shape) // _TILES)
    rows, columns = (-(-length // side) for length in shape)
    place = pixel // shape[1] // side * columns + pixel % shape[1] // side
    total = np.bincount(place, values, minlength=rows * columns)
    count = np.bincount(place, minlength=rows * columns)
    empty = np.full(len(count), np.nan)
    return np.divide(total, count, out=empty, where=count > 0).reshape(rows, columns)
