r"""Images of walls after correction, as residuals to the wall that each one shows.

A camera that has drifted reads too far by some :math:`\delta` along every ray. After correction
the distance of a pixel to its wall is then

.. math:: r_v = g_v \delta + \text{(what the wall's unknown place explains)} + \text{noise},
    \quad g_v = n \cdot a_v

with the wall's normal n towards the camera and the unit ray :math:`a_v`.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from tofcorr.correction.state import CalibrationState
from tofcorr.data.frames import FrameBatch
from tofcorr.error_terms.model import ErrorModel
from tofcorr.fit.reference.form_functions import FormFunctions
from tofcorr.fit.reference.linear_image import LinearImage, Linearisation, wall_moves
from tofcorr.geometry.planes import plane_in_frame
from tofcorr.pixels.dataset import Dataset
from tofcorr.pixels.domain import within
from tofcorr.pixels.masks import image_planes, off_the_wall
from tofcorr.pixels.sample import error_at, pixels_of_image, some_pixels

Wall = Literal["per_image", "one", "recorded"]
"""What is known of the wall: nothing; that all images show one wall; its recorded plane."""

FEWEST_PIXELS = 50
"""Usable pixels below which an image is not used. Its wall alone has three unknowns; fifty pixels
determine them with room to spare. Set by hand, of no influence on whole images."""

# Side, in pixels, of the blocks whose means show how flat a corrected wall is: 64 pixels reduce
# the noise of a mean to an eighth, and bends of the calibrated shape are much wider than 8 pixels.
_BLOCK = 8

# Most pixels of an image whose residuals show an offset. Chosen: with more, what the calibration
# left unknown is larger than the noise, whatever the wall.
_MOST_PIXELS = 5_000


class CorrectedImage(NamedTuple):
    """One image after correction: M usable pixels on its wall.

    Attributes:
        frame: Its global number.
        points: Corrected points in the camera frame, shape (M, 3), metres.
        plane: The wall that the image shows: unit normal (3,) and offset, metres.
        block: Number of the block of the image that each pixel lies in, shape (M,).
        linear: Residuals of S of the pixels to the assumed wall, and what changes them.
        shared_wall: Change of these by two turns and a shift of the wall in world axes, shape
            (S, 3), where all images share one wall; None elsewhere.
    """

    frame: int
    points: Tensor
    plane: tuple[Tensor, Tensor]
    block: Tensor
    linear: LinearImage
    shared_wall: Tensor | None


@dataclass
class PixelCount:
    """How many pixels were met.

    Attributes:
        on_wall: Pixels on the wall that their image shows.
        calibrated: Those of them within the calibrated ranges, which alone are used.
    """

    on_wall: int = 0
    calibrated: int = 0

    @property
    def share_outside(self) -> float:
        """Share of the pixels on walls that lie outside the calibrated ranges."""
        return 1 - self.calibrated / max(self.on_wall, 1)


def corrected_images(
    state: CalibrationState, dataset: Dataset, wall: Wall, count: PixelCount
) -> Iterator[CorrectedImage]:
    """Correct the images that have enough usable pixels.

    Args:
        state: The calibration.
        dataset: The images.
        wall: What is known of the wall.
        count: Adds up the pixels of all images, also of those not returned.
    """
    rays = dataset.ray_directions()
    model, off_wall = state.model(), off_the_wall(rays)
    linear = Linearisation(
        model.error, FormFunctions(state.domain), rays, twist=state.hand_eye_estimated
    )
    # Without a robot the recorded planes are in the camera's own coordinates.
    hand_eye = state.tool_from_camera if dataset.moves else torch.eye(4, dtype=torch.float64)
    poses = torch.cat(
        [torch.from_numpy(recording.frames.world_from_tool) for recording in dataset.recordings]
    )
    for batch in dataset.batches():
        on_wall = batch.valid & ~off_wall(batch)
        inside = on_wall & within(state.domain, batch.radial_distance, batch.amplitude)
        count.on_wall += int(on_wall.sum())
        count.calibrated += int(inside.sum())
        corrected = _corrected(model.error, batch, inside)
        planes = image_planes(corrected, rays)
        for k, frame in enumerate(batch.indices.tolist()):
            used = inside[k].flatten().nonzero()[:, 0]
            if len(used) < FEWEST_PIXELS:
                continue
            plane = shown = planes.normal[k], planes.offset[k]
            if wall != "per_image":
                plane = plane_in_frame(batch.normal_tool[k], batch.offset_tool[k], hand_eye)
            image = linear(batch, k, some_pixels(used, _MOST_PIXELS, frame), plane, shown)
            shared = None
            if wall == "one":
                shared = wall_moves(image.points, plane[0], poses[frame] @ hand_eye)
            distance = corrected.radial_distance[k].flatten()[used]
            yield CorrectedImage(
                frame=frame,
                points=rays.flatten(0, 1)[used] * distance[:, None],
                plane=shown,
                block=_blocks(used, rays.shape[1]),
                linear=image,
                shared_wall=shared,
            )


def _corrected(error: ErrorModel, batch: FrameBatch, inside: Tensor) -> FrameBatch:
    """Return the batch with corrected distances, valid where `inside`."""
    distance = batch.radial_distance.clone()
    for k in range(len(distance)):
        used = inside[k].flatten().nonzero()[:, 0]
        flat = distance[k].flatten()
        flat[used] -= error_at(error, pixels_of_image(batch, k, used))
        distance[k] = flat.view(distance.shape[1:])
    return replace(batch, radial_distance=distance, valid=inside)


def _blocks(used: Tensor, width: int) -> Tensor:
    across = -(-width // _BLOCK)
    return (used // width // _BLOCK) * across + used % width // _BLOCK
