r"""The residual of one image, linear in all that may be wrong.

.. math:: r_v = n \cdot \big(R\,a_v (D_v - E_v) + t\big) + d

changes with the hand-eye's twist, the model's coefficients, the functions by which its form may be
wrong, and the wall's place: two turns and a shift, which an error of the robot's pose gives to each
image. With :math:`g_v = n \cdot a_v`, an error of the distance along the ray changes it by
:math:`g_v`.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from tofcorr.data.frames import FrameBatch
from tofcorr.error_terms.model import ErrorModel
from tofcorr.fit.reference.form_functions import FormFunctions, shapes
from tofcorr.geometry.planes import tangents
from tofcorr.pixels.sample import error_at, pixels_of_image


class LinearImage(NamedTuple):
    """One image, M pixels.

    Attributes:
        residual: Distances of the corrected points to the plane, shape (M,), metres.
        gain: Their change by an error of the distance along the ray, shape (M,).
        points: Points of the wall in the camera frame, shape (M, 3), metres.
        moves: Change of the residual by two turns and a shift of the wall, shape (M, 3).
        shapes: Change by smooth errors of this image alone, shape (M, S).
        unknowns: Change by the twist (if it was estimated), the model's coefficients and the
            functions of its form, shape (M, P).
        amplitude: Of each pixel, shape (M,); None without amplitudes.
        rows: Of the pixels in the image, shape (M,).
        columns: The same.
        normal: Of the wall in the camera frame, shape (3,).
    """

    residual: Tensor
    gain: Tensor
    points: Tensor
    moves: Tensor
    shapes: Tensor
    unknowns: Tensor
    amplitude: Tensor | None
    rows: Tensor
    columns: Tensor
    normal: Tensor


class Linearisation(NamedTuple):
    """Gives the linear form of an image under one calibration.

    Attributes:
        error: The error model.
        forms: Functions by which its form may be wrong.
        ray_directions: Unit rays, shape (H, W, 3).
        twist: Whether the hand-eye transform was estimated.
    """

    error: ErrorModel
    forms: FormFunctions
    ray_directions: Tensor
    twist: bool

    def __call__(
        self,
        batch: FrameBatch,
        k: int,
        used: Tensor,
        plane: tuple[Tensor, Tensor],
        shown: tuple[Tensor, Tensor] | None = None,
    ) -> LinearImage:
        """Return image k of a batch.

        Args:
            batch: The images, distances as measured.
            k: Which one.
            used: Numbers of the pixels, counted row by row, shape (M,).
            plane: The wall in the camera frame: unit normal (3,) and offset, metres.
            shown: The wall where the image shows it, if that is not the same.
        """
        normal, offset = plane
        pixels = pixels_of_image(batch, k, used)
        rays = self.ray_directions.flatten(0, 1)[used]
        corrected = pixels.radial_distance - error_at(self.error, pixels)
        gain = rays @ normal
        residual = gain * corrected + offset
        # What changes the residuals is computed where the wall is, not where noise puts the pixels:
        # else a scale of the distance would explain the noise.
        smooth = -(offset if shown is None else shown[1]) / (
            gain if shown is None else rays @ shown[0]
        )
        pixels = pixels._replace(radial_distance=pixels.radial_distance - corrected + smooth)
        points = rays * smooth[:, None]
        with torch.no_grad():
            columns = torch.cat([self.error.columns_at(pixels), self.forms(pixels, gain)])
        unknowns = -gain[:, None] * columns.T
        if self.twist:
            turned = torch.linalg.cross(points, normal.expand_as(points))
            unknowns = torch.cat([normal.expand_as(points), turned, unknowns], dim=1)
        return LinearImage(
            residual=residual,
            gain=gain,
            points=points,
            moves=wall_moves(points - points.mean(dim=0), normal),
            shapes=gain[:, None] * shapes(pixels.rows, pixels.columns).T,
            unknowns=unknowns,
            amplitude=None if batch.amplitude is None else pixels.amplitude,
            rows=pixels.rows,
            columns=pixels.columns,
            normal=normal,
        )


def wall_moves(points: Tensor, normal: Tensor, world_from_camera: Tensor | None = None) -> Tensor:
    """Return the change of the residuals by two turns and a shift of the wall, shape (M, 3).

    Args:
        points: In the camera frame, shape (M, 3), metres.
        normal: The wall's unit normal in the camera frame, shape (3,).
        world_from_camera: Pose (4, 4) for a wall that does not move with the camera; None: the
            wall of each image is by itself.
    """
    if world_from_camera is not None:
        points = points @ world_from_camera[:3, :3].T + world_from_camera[:3, 3]
        normal = world_from_camera[:3, :3] @ normal
    return torch.cat([points @ tangents(normal).T, torch.ones_like(points[:, :1])], dim=1)
