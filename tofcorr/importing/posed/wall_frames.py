"""The frames of the recording: one for each image and wall."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from tofcorr.data.table import FrameRow
from tofcorr.importing.engine import ImportedFrame
from tofcorr.importing.posed.chosen import Chosen
from tofcorr.importing.posed.images import RadialImages
from tofcorr.importing.report import ImportedView
from tofcorr.importing.walls.found import FoundWalls, WallView
from tofcorr.importing.walls.image_planes import plane_masks


@dataclass(frozen=True, kw_only=True)
class WallFrame(ImportedView):
    """One frame of the recording: one image of one wall.

    Attributes:
        wall: The wall's name.
        stop: Number of the stop; -1 while moving.
        timestamp_s: Of the image, on its own clock; None without time stamps.
    """

    wall: str
    stop: int
    timestamp_s: float | None


class WallFrames:
    """Turns images and walls into frames.

    Args:
        images: All images.
        times: Of all images, shape (I,), seconds; None without time stamps.
        chosen: Which images are used.
        found: The walls they show.
        tolerance: Largest deviation of a wall's pixel along the ray, metres.
    """

    def __init__(
        self,
        images: RadialImages,
        times: np.ndarray | None,
        chosen: Chosen,
        found: FoundWalls,
        tolerance: float,
    ) -> None:
        self._images, self._times, self._tolerance = images, times, tolerance
        self._chosen, self._found = chosen, found

    def reported(self) -> list[WallFrame]:
        """Return what `import.json` says of each frame."""
        frames = []
        for index, view in enumerate(self._found.views):
            number = int(self._chosen.images[view.image])
            frames.append(
                WallFrame(
                    frame=index,
                    view=self._images.source.names[number],
                    wall=self._found.walls[view.wall].name,
                    stop=int(self._chosen.stop[view.image]),
                    timestamp_s=None if self._times is None else float(self._times[number]),
                )
            )
        return frames

    def frame(self, index: int) -> ImportedFrame:
        """Return one frame, ready to be written."""
        view = self._found.views[index]
        number = int(self._chosen.images[view.image])
        image = self._images.read(number)
        wall = self._found.walls[view.wall]
        stop = int(self._chosen.stop[view.image])
        timestamp = float(view.image)
        if self._times is not None:
            timestamp = float(self._times[number] - self._times[self._chosen.images[0]])
        row = FrameRow(
            timestamp=timestamp,
            world_from_tool=self._chosen.world_from_tool[view.image],
            normal_world=wall.normal_world,
            offset=wall.offset,
            target=wall.name,
            pose_id=f"stop {stop}" if stop >= 0 else f"image {number}",
        )
        return ImportedFrame(
            row=row, depth=image.depth, amplitude=image.amplitude, mask=self._mask(view, number)
        )

    def _mask(self, view: WallView, number: int) -> np.ndarray:
        """Return which pixels of an image look at one of its walls, shape (H, W)."""
        distance, valid = self._images.radial(number)
        if view.gradient is None:
            return valid.numpy()
        own = [other for other in self._found.views if other.image == view.image]
        gradients = [other.gradient for other in own if other.gradient is not None]
        masks = plane_masks(
            distance,
            valid,
            self._images.rays,
            torch.from_numpy(np.stack(gradients)),
            self._tolerance,
        )
        return masks[_place(own, view)].numpy()


def _place(views: Sequence[WallView], view: WallView) -> int:
    return next(k for k, other in enumerate(views) if other is view)
