"""The figure of missing pixels: over the amplitude, and over the image.

The maps stand below the curves, so that the words can be read on a narrow page too.
"""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from tofcorr.observables.compare import Observables
from tofcorr.observables.dropouts import DropoutMeasurement
from tofcorr.observables.figure_parts import FEWEST, POINTS, binned, centres, plain, plain_numbers
from tofcorr.observables.style import BLUE, RED, WIDTH

# Heights of the curves and of the maps, of their margins above and below, inches. Chosen.
_CURVES, _MAPS, _ABOVE, _BELOW = 2.3, 1.9, 0.3, 0.55


def dropout_figure(observables: Observables) -> Figure:
    """Draw the share of missing pixels over the amplitude, and over the image."""
    compared = observables.dropouts
    shown = [("recording", observables.real_dropouts, RED)]
    if compared is not None:
        shown.append(("simulator", compared.sim, BLUE))
    with_amplitude = any(np.isfinite(each.amplitude).any() for _, each, _ in shown)
    height = _ABOVE + _MAPS + with_amplitude * (_ABOVE + _CURVES + _BELOW)
    figure = Figure(figsize=(WIDTH, height))
    if with_amplitude:
        bottom = (_ABOVE + _MAPS + _BELOW) / height
        _dropout_curves(figure.add_axes((0.13, bottom, 0.82, _CURVES / height)), shown)
    highest = max(0.1, *(100 * float(np.nanmax(each.map)) for _, each, _ in shown))
    # Two recordings are compared over the pixels of both: the shares that the report states.
    shares = [each.share for _, each, _ in shown]
    if compared is not None:
        shares = [compared.real_share, compared.sim_share]
    tall = _MAPS / height
    for number, ((name, dropouts, _), share) in enumerate(zip(shown, shares, strict=True)):
        axes = figure.add_axes((0.02 + 0.4 * number, 0.02 * tall, 0.38, 0.96 * tall))
        axes.imshow(100 * dropouts.map, cmap="magma_r", vmin=0, vmax=highest)
        axes.set_title(f"{name}: {100 * share:.2f} % missing", fontsize=10)
        axes.set_xticks([])
        axes.set_yticks([])
    image = figure.axes[-1].images[0]
    place = figure.add_axes((0.04 + 0.4 * len(shown), 0.15 * tall, 0.02, 0.7 * tall))
    figure.colorbar(image, cax=place).set_label("missing, %")
    return figure


def _dropout_curves(axes: Axes, shown: list[tuple[str, DropoutMeasurement, str]]) -> None:
    for name, dropouts, colour in shown:
        _dropout_points(axes, dropouts, colour, name)
    axes.set_ylabel("pixels without distance, %")
    axes.set_xlabel("amplitude, counts")
    axes.set_ylim(bottom=0.0)
    axes.legend(frameon=False)
    plain_numbers(axes.xaxis)
    plain([axes])


def _dropout_points(axes: Axes, dropouts: DropoutMeasurement, colour: str, name: str) -> None:
    table = dropouts.observed.table
    use = np.isfinite(dropouts.amplitude) & (dropouts.amplitude > 0)
    if not use.any():
        return
    at = dropouts.amplitude[use]
    edges = np.geomspace(np.quantile(at, 0.0005), np.quantile(at, 0.9995), POINTS + 1)
    mean, count = binned(at, table.missing[use] / table.frames[use], edges)
    enough = count >= FEWEST
    axes.plot(
        centres(edges)[enough], 100 * mean[enough], "o", color=colour, markersize=4, label=name
    )
    line = np.geomspace(edges[0], edges[-1], 200)
    axes.plot(line, 100 * dropouts.model.probability(line), color=colour, linewidth=1.2)
    axes.set_xscale("log")
