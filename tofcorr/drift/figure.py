"""The chart of a drift check: offset and flatness by image."""

from collections.abc import Mapping

from matplotlib.figure import Figure


def drift_figure(
    images: Mapping[int, tuple[float, float]], interval: tuple[float, float], threshold: float
) -> Figure:
    """Draw each image's offset and flatness.

    Args:
        images: Offset and flatness of each image by its frame number, millimetres.
        interval: 95 % interval of the offset of all images, millimetres.
        threshold: Offset or flatness above which the camera counts as drifted, millimetres.
    """
    figure = Figure(figsize=(7.0, 5.0), layout="constrained")
    top, bottom = figure.subplots(2, 1, sharex=True)
    frames = list(images)
    top.axhspan(*interval, color="C0", alpha=0.2, label="all images, 95 % interval")
    top.plot(frames, [offset for offset, _ in images.values()], "o", color="C0", label="one image")
    bottom.plot(frames, [flatness for _, flatness in images.values()], "o", color="C1")
    for axes, ends in ((top, (-threshold, threshold)), (bottom, (threshold,))):
        for end in ends:
            axes.axhline(end, color="C3", linestyle="--", linewidth=1)
        axes.grid(alpha=0.25)
    top.set_ylabel("reads too far by [mm]")
    top.legend(fontsize=8)
    bottom.set_ylabel("departure from a plane [mm]")
    bottom.set_ylim(bottom=0.0)
    bottom.set_xlabel("frame (dashed: threshold)")
    return figure
