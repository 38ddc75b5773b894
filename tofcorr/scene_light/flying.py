r"""Flying pixels: pixels that mix the light of two surfaces and measure the distance of neither.

On a plane the inverse depth w = 1/z is linear in the pixel. A plane is fitted to every square of
3 x 3 pixels. It counts if it fits them within their noise, and is not so steep that it must be an
edge. A pixel is flying if neither holds:

* One of the eight squares around it that do not contain it has a plane that continues to it.
* Three of its eight neighbours have its inverse depth.

Both compare within z standard deviations. For independent normal noise of variance s of w, and a
plane p continued over i columns and j rows, counted in the spacing of the square's pixels, from the
middle of a square whose mean variance is S:

.. math:: (w - p)^2 \le z^2 \Big(s + S \Big(\frac19 + \frac{i^2 + j^2}{6}\Big)\Big), \quad
          z = \Phi^{-1}(1 - \alpha / 2)

A pixel of a surface with one such square is then flagged with probability alpha at most, and with
more of them less often, whatever its tilt.

A flying pixel takes shares a and 1 - a of its area from a nearer and a farther surface. As long as
the phases of both differ by little, it measures the mean of their distances, weighted with their
light (amplitudes A):

.. math:: \frac{a}{1 - a} = \frac{A_2}{A_1} \, \frac{r_2 - r}{r - r_1}

The surface with the larger share is the one that the middle of the pixel sees.
"""

import math
from typing import Annotated

import torch
from pydantic import Field
from torch import Tensor, nn

from tofcorr.geometry.camera import CameraIntrinsics, DepthKind
from tofcorr.geometry.rays import ray_directions
from tofcorr.options import FiniteNumber, NonNegativeNumber, Number, Options
from tofcorr.scene_light.planes import STEEPEST

_REACH = 5
"""Pixels on either side of an edge at which its brightness is read. Chosen: light of a camera in
focus spreads over one."""


class FlyingPixelsOptions(Options):
    """What is to be found.

    Attributes:
        false_alarm: Probability at most with which a pixel of one surface is flagged.
    """

    false_alarm: Annotated[FiniteNumber, Field(ge=1e-9, le=0.1)] = 1e-3


class FlyingPixelsState(FlyingPixelsOptions):
    """What finding flying pixels takes, as the recording shows it.

    Attributes:
        point_spread_px: Standard deviation over which a point's light spreads, the area of a pixel
            included, pixels.
        noise: a, b, c of the variance a + b / A + c / A^2 of a distance at amplitude A beside its
            neighbours on a plane, metres and the camera's units.
    """

    point_spread_px: Annotated[Number, Field(ge=0, le=10)]
    noise: tuple[NonNegativeNumber, NonNegativeNumber, NonNegativeNumber]


class FlyingPixels(nn.Module):
    """Finds flying pixels in single frames, and the surface that they see where it is certain.

    Args:
        camera: The lateral parameters.
        depth_kind: What depth means.
        state: Point spread, noise and rate of false alarms.

    Shape:
        - Input: `(H, W)` or `(B, H, W)` three times.
        - Output: the same shape.
    """

    z_of_ray: Tensor
    z_of_depth: Tensor
    around: list[tuple[int, int]]
    noise: list[float]
    focal: list[float]

    def __init__(
        self, camera: CameraIntrinsics, depth_kind: DepthKind, state: FlyingPixelsState
    ) -> None:
        super().__init__()
        from scipy.special import chdtri, ndtri  # Slow to import.

        self.threshold: float = float(-ndtri(state.false_alarm / 2))
        # A plane leaves six of the nine numbers.
        self.most_misfit: float = float(chdtri(6, state.false_alarm))
        self.noise = list(state.noise)
        self.steepest: float = math.tan(math.acos(STEEPEST))
        # A right-angled corner of the other surface that reaches the middle takes a quarter.
        self.majority: float = 1 - 0.5**2
        beside = (-1, 0, 1)
        self.around = [(row, column) for row in beside for column in beside if row or column]
        # As far apart as light spreads, so that no plane fits a blurred edge.
        self.spacing: int = max(1, round(state.point_spread_px))
        # Planes on either side of an edge in the pixel: their squares begin where the edge leaves
        # less of the other surface's light than the rate of false alarms.
        clear = math.ceil(0.5 + self.threshold * state.point_spread_px)
        self.beyond: int = self.spacing + max(self.spacing, clear)
        self.margin: int = self.spacing + self.beyond
        self.focal = [camera.matrix[0][0], camera.matrix[1][1]]
        z_of_ray = ray_directions(camera)[..., 2].float()
        z_of_depth = torch.ones_like(z_of_ray) if depth_kind == "z" else z_of_ray
        z_of_ray = nn.functional.pad(z_of_ray, [self.margin] * 4, value=math.nan)
        self.register_buffer("z_of_ray", z_of_ray)
        self.register_buffer("z_of_depth", z_of_depth.contiguous())

    def forward(self, depth: Tensor, amplitude: Tensor, valid: Tensor) -> tuple[Tensor, Tensor]:
        """Return depth with that of certain surfaces in place of mixtures, and what is valid.

        Args:
            depth: Of the camera's kind, metres; NaN without a return.
            amplitude: The camera's units.
            valid: Where the depth is valid.

        Returns:
            Depth, and `valid` without the flying pixels.
        """
        flying, seen = self.found(depth, amplitude)
        return torch.where(seen.isfinite(), seen, depth), valid & ~flying

    def found(self, depth: Tensor, amplitude: Tensor) -> tuple[Tensor, Tensor]:
        """Return which pixels are flying, bool, and the depth of the surface that they see.

        The depth is NaN where a pixel is not flying, or no surface is certain.
        """
        pads, z_of_ray, z_of_depth = [self.margin] * 4, self.z_of_ray, self.z_of_depth
        amplitude = nn.functional.pad(amplitude, pads, value=math.nan)
        inverse = nn.functional.pad(1.0 / (depth * z_of_depth), pads, value=math.nan)
        # The least amplitude, for zero times infinity would be NaN.
        weakness = 1.0 / amplitude.clamp(min=2.0**-126)
        variance = self.noise[0] + weakness * (self.noise[1] + self.noise[2] * weakness)
        # A change dr of the distance changes 1/z by dr z_of_ray / z^2.
        variance = variance * (inverse * inverse * z_of_ray).square()
        planes = self.planes(inverse, variance)
        flying = self.on_no_surface(inverse, variance, planes)
        lights = self.three(self.three(amplitude, -1)[0], -2)[0]
        seen = self.seen_surface(self.inner(inverse), self.inner(variance), lights, planes)
        seen = torch.where(flying, seen, torch.full_like(seen, math.nan))
        return flying, 1.0 / (seen * z_of_depth)

    def missed(self, depth: Tensor, amplitude: Tensor) -> Tensor:
        """Return how far off pixels beside flying ones are that were not found; 0 elsewhere.

        In standard deviations of noise, evenly spread up to the threshold. On
        `benchmarks/scene_light/edges.py` it was 1.6 to 1.7.
        """
        flying, _ = self.found(depth, amplitude)
        around = flying.to(depth.dtype).reshape(-1, 1, depth.shape[-2], depth.shape[-1])
        beside = nn.functional.max_pool2d(around, 3, 1, 1).reshape(depth.shape)
        return self.threshold / 3**0.5 * beside

    def departures(self, depth: Tensor) -> Tensor:
        """Return by how much pixels are off the plane beside them, scaled to the noise of one.

        Args:
            depth: Of the camera's kind, shape (..., H, W), metres.

        Returns:
            Along the ray, metres; NaN where there is no square on the right.
        """
        inverse = 1.0 / (depth * self.z_of_depth)
        padded = nn.functional.pad(inverse, [self.margin] * 4, value=math.nan)
        planes = self.planes(padded, torch.full_like(padded, math.inf))
        off = inverse - self.continued(planes, inverse, 0, 1, 2 * self.spacing)
        # The variance of the plane there is 1/9 + 4/6 of a pixel's.
        return off * 3 / (4 * inverse * inverse * self.inner(self.z_of_ray))

    def planes(self, inverse: Tensor, variance: Tensor) -> list[Tensor]:
        """Return the planes of the squares around the pixels of images with a margin.

        Returns:
            w in the middle, NaN if no plane fits; its step from column to column and from row to
            row; and the mean variance of the square.
        """
        # Sum, slope and curvature along each axis: nine orthogonal combinations of the nine pixels.
        level, across, bent = self.three(inverse, -1)
        level, down, down_bent = self.three(level, -2)
        across, twist, across_bent = self.three(across, -2)
        bent, bent_down, bent_twice = self.three(bent, -2)
        misfit = (bent.square() + down_bent.square()) / 18 + twist.square() / 4
        misfit = misfit + (bent_down.square() + across_bent.square()) / 12
        misfit = misfit + bent_twice.square() / 36
        pixels = 6 * self.spacing
        level, across, down = level / 9, across / pixels, down / pixels
        noise = self.three(self.three(variance, -1)[0], -2)[0] / 9
        slope = (across * self.focal[0]).square() + (down * self.focal[1]).square()
        plane = (misfit <= self.most_misfit * noise) & (slope <= (self.steepest * level).square())
        return [torch.where(plane, level, torch.full_like(level, math.nan)), across, down, noise]

    def on_no_surface(self, inverse: Tensor, variance: Tensor, planes: list[Tensor]) -> Tensor:
        """Return which pixels are on no plane beside them, and unlike most of their neighbours."""
        own, own_variance = self.inner(inverse), self.inner(variance)
        continued = torch.zeros_like(own, dtype=torch.bool)
        # Along a straight edge two neighbours mix the same surfaces in the same shares: three alike
        # are a surface.
        alike = torch.zeros_like(own)
        limit = self.threshold * self.threshold
        for row, column in self.around:
            plane = self.continued(planes, own, row, column, 2 * self.spacing)
            noise = self.beside(planes[3], own, row, column, 2 * self.spacing)
            noise = own_variance + noise * (2 + 12 * (row * row + column * column)) / 18
            continued = continued | ((own - plane).square() <= limit * noise)
            other = self.beside(inverse, own, row, column, self.spacing)
            noise = own_variance + self.beside(variance, own, row, column, self.spacing)
            alike = alike + ((own - other).square() <= limit * noise).to(own.dtype)
        return (own_variance > 0) & ~continued & (alike < 3)

    def seen_surface(
        self, inverse: Tensor, variance: Tensor, lights: Tensor, planes: list[Tensor]
    ) -> Tensor:
        """Return w of the surface that a pixel between two of them sees; NaN: not certain."""
        nowhere = torch.full_like(inverse, math.nan)
        near, far = torch.full_like(inverse, math.inf), torch.zeros_like(inverse)
        near_light, far_light = torch.ones_like(inverse), torch.ones_like(inverse)
        for row, column in self.around:
            plane = self.continued(planes, inverse, row, column, self.beyond)
            light = self.beside(lights, inverse, row, column, self.beyond)
            better = (plane > inverse) & (plane < near)
            near = torch.where(better, plane, near)
            near_light = torch.where(better, light, near_light)
            better = (plane < inverse) & (plane > far)
            far = torch.where(better, plane, far)
            far_light = torch.where(better, light, far_light)
        of_near = (inverse - far) * near * far_light
        share = of_near / (of_near + (near - inverse) * far * near_light)
        least = self.majority + self.threshold * variance.sqrt() / (near - far)
        seen = torch.where(share >= least, near, torch.where(1.0 - share >= least, far, nowhere))
        return torch.where(far > 0, seen, nowhere)

    def three(self, image: Tensor, axis: int) -> tuple[Tensor, Tensor, Tensor]:
        """Return sum, slope and curvature of three pixels along an axis; the border is lost."""
        size = image.shape[axis] - 2 * self.spacing
        first = image.narrow(axis, 0, size)
        middle = image.narrow(axis, self.spacing, size)
        last = image.narrow(axis, 2 * self.spacing, size)
        ends = first + last
        return ends + middle, last - first, ends - 2.0 * middle

    def inner(self, image: Tensor) -> Tensor:
        """Return an image without its margin."""
        rows, columns = image.shape[-2] - 2 * self.margin, image.shape[-1] - 2 * self.margin
        return image.narrow(-2, self.margin, rows).narrow(-1, self.margin, columns)

    def beside(self, image: Tensor, like: Tensor, row: int, column: int, pixels: int) -> Tensor:
        """Return what an image with some margin has so many pixels away, the shape of `like`."""
        height, width = like.shape[-2], like.shape[-1]
        top = (image.shape[-2] - height) // 2 + row * pixels
        left = (image.shape[-1] - width) // 2 + column * pixels
        return image.narrow(-2, top, height).narrow(-1, left, width)

    def continued(
        self, planes: list[Tensor], like: Tensor, row: int, column: int, pixels: int
    ) -> Tensor:
        """Return w of the planes of squares so many pixels away, continued to every pixel."""
        level = self.beside(planes[0], like, row, column, pixels)
        across = self.beside(planes[1], like, row, column, pixels)
        down = self.beside(planes[2], like, row, column, pixels)
        return level - (across * (column * pixels) + down * (row * pixels))


def squared_spreads(amplitude: Tensor) -> Tensor:
    """Return the squared point spread that every sharp edge of brightness shows, (M,), pixels.

    The differences of neighbours on a line across an edge, less the slopes of brightness on either
    side, are the point spread. It is widened by the step of a pixel, whose variance is 1/12, and by
    the slope of an oblique edge.

    Args:
        amplitude: Images (B, H, W); NaN: not to be used.
    """
    found = []
    for images in (amplitude, amplitude.mT):
        lines = images.unfold(-1, 2 * _REACH + 2, 1)
        steps = lines.diff(dim=-1)
        before, after = (steps[..., part].mean(-1) for part in (slice(2), slice(-2, None)))
        sides = [before] * _REACH + [(before + after) / 2] + [after] * _REACH
        edge = steps - torch.stack(sides, dim=-1)
        contrast = edge.sum(-1, keepdim=True)
        share, place = edge / contrast, torch.arange(-_REACH, _REACH + 1.0)
        middle = (share * place).sum(-1, keepdim=True)
        spread = (12 * (share * (place - middle).square()).sum(-1) - 1) / 12
        # By how many pixels the edge moves from line to line.
        slope = nn.functional.pad(
            (lines[..., 2:, :, :] - lines[..., :-2, :, :]).sum(-1), [0, 0, 1, 1]
        )
        slope = slope / (2 * contrast[..., 0])
        outer = (steps / contrast).abs()[..., [0, 1, -2, -1]].amax(-1)
        # It doubles the brightness, and beside it is less of it than if all steps were alike.
        sharp = contrast[..., 0].abs() > lines[..., [0, -1]].amin(-1)
        inner = (middle[..., 0].abs() <= 0.5) & (slope.abs() < 1) & (outer < 1 / share.shape[-1])
        found.append((spread / (1 + slope.square()))[sharp & inner])
    return torch.cat(found)
