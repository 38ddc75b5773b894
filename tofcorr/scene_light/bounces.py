r"""Second bounces: light that reaches a pixel by further surfaces of the scene, found in the frame.

With :math:`k = 2 \pi f / c`, a pixel measures the phasor :math:`M = D (1 + q)`: direct light D, of
phase 2 k r, and a ratio q of light by further bounces. A matt patch j of the scene, of area
:math:`A_j = \Omega_j r_j^2 / c_j`, sends the room the radiance that it sends the camera. So its
measured phasor holds every order of bounce among the patches that the camera sees:

.. math:: q_i = s \, \frac{l_i^2}{c_i} \sum_j A_j |M_j|
    e^{\mathrm{i} (k (l_j + d_{ij} - l_i) + \arg(1 + q_j))}
    \frac{\cos\theta_{ij} \cos\theta_{ji}}{d_{ij}^2 + A_j / \pi}

l is the distance from the light, c the cosine of its incidence, d the distance of two patches. The
area under d is that of a disk, seen from above its middle: the sum stays finite in a corner. The
reflectivity of i cancels. The gain s is a constant of the camera.
"""

import math
from typing import Annotated, Literal

import torch
from pydantic import Field
from torch import Tensor, nn

from tofcorr.geometry.camera import CameraIntrinsics
from tofcorr.geometry.rays import SPEED_OF_LIGHT, ray_directions
from tofcorr.options import FiniteNumber, NonNegativeNumber, Number, Options, PositiveNumber
from tofcorr.scene_light.planes import OFF_PLANE, STEEPEST, CellPlanes
from tofcorr.scene_light.remainder import Remainder
from tofcorr.scene_light.room import Faces, Room

_PATCHES = (32, 24)
"""Columns and rows of patches at most, if no size is given. Asked for: 768 of a frame of 4:3."""
_SAMPLES = 4
"""Places on half the way between two patches at which something may stand in between. Chosen."""


class SecondBouncesOptions(Options):
    """Light and patches of second bounces.

    Attributes:
        patch_px: Side of a patch in pixels, even; None: so many that there are 32 x 24 of them.
        light_m: Position of the light in the camera's axes, metres.
        light_half_angle_deg: How far off the optical axis light reaches; None: to the image's
            corners.
        continued: Whether planes at the border of the image go on beyond it.
        room: What stands around and does not move: faces, or a `MeshFile`. Beyond the image it is
            taken where it is met, in place of planes that go on.
        room_in_image: Whether its planes are taken in the image too, wherever nothing stands
            before it: those that a frame shows are bent by second bounces.
        room_axes: Of the corners: the world in which poses are stated, or the camera's. The room of
            a world is used from `Room.set_pose` on.
    """

    patch_px: Annotated[int, Field(ge=2, multiple_of=2)] | None = None
    light_m: tuple[Number, Number, Number] = (0.0, 0.0, 0.0)
    light_half_angle_deg: Annotated[FiniteNumber, Field(gt=0, le=80)] | None = None
    continued: bool = True
    room: Faces = ()
    room_in_image: bool = True
    room_axes: Literal["world", "camera"] = "world"


Frequencies = Annotated[tuple[PositiveNumber, ...], Field(min_length=1, max_length=8)]


Planes = tuple[Tensor, Tensor, Tensor]
"""What `SecondBounces.planes` returns."""


class SecondBouncesState(SecondBouncesOptions):
    """What the removal of second bounces takes.

    Attributes:
        frequencies_hz: Modulation frequencies. Of several the distance is taken as their mean with
            the weights of least noise, f^2.
        gain: One over pi times the amplitude that white paper has at 1 m, seen straight on.
        gain_interval: Of 95 %; None: it was given.
    """

    frequencies_hz: Frequencies
    gain: NonNegativeNumber
    gain_interval: tuple[Number, Number] | None = None


class SecondBounces(nn.Module):
    """The light of second bounces in a camera's frames.

    A frame is reduced to cells of half a patch. 2 x 2 cells are a patch that sends light.

    Args:
        camera: The intrinsics.
        state: Frequencies, gain, patches and light.

    Attributes:
        remainder: Says what the removal leaves; None: that stays.

    Shape:
        - Frames: `(H, W)`, distances along the ray in metres, NaN without a return. A batch
          `(B, H, W)` in `forward`.
    """

    rays: Tensor
    cell_rays: Tensor
    solid: Tensor
    light: Tensor
    out_rays: Tensor
    out_solid: Tensor
    out_from: Tensor
    table: Tensor
    corners: Tensor
    shares: Tensor
    wave_numbers: list[float]
    weights: list[float]
    pads: list[int]

    def __init__(self, camera: CameraIntrinsics, state: SecondBouncesState) -> None:
        super().__init__()
        self.remainder: Remainder | None = None
        size = camera.height, camera.width
        most = max(camera.width / _PATCHES[0], camera.height / _PATCHES[1])
        self.cell: int = (state.patch_px or 2 * math.ceil(most / 2)) // 2
        self.rows: int = 2 * math.ceil(size[0] / (2 * self.cell))
        self.columns: int = 2 * math.ceil(size[1] / (2 * self.cell))
        self.pads = [0, self.columns * self.cell - size[1], 0, self.rows * self.cell - size[0]]
        self.gain: float = state.gain
        self.wave_numbers = [2 * math.pi * f / SPEED_OF_LIGHT for f in state.frequencies_hz]
        total = sum(f * f for f in state.frequencies_hz)
        self.weights = [f * f / total for f in state.frequencies_hz]
        self.off_plane: float = OFF_PLANE
        self.steepest: float = STEEPEST
        self.samples: int = _SAMPLES
        rays = ray_directions(camera)
        slopes = rays[..., :2] / rays[..., 2:]
        pitch = [float(slopes[..., i].diff(dim=1 - i).mean()) for i in (0, 1)]
        padded = nn.functional.pad(rays.permute(2, 0, 1)[None], self.pads, mode="replicate")
        cell_rays = nn.functional.avg_pool2d(padded, self.cell)[0].reshape(3, -1)
        cell_rays = nn.functional.normalize(cell_rays, dim=0)
        # Of a pixel on the plane z = 1; distortion changes it as it changes the pitch, a little.
        solid = nn.functional.pad((pitch[0] * pitch[1] * rays[..., 2] ** 3)[None], self.pads)
        solid = nn.functional.avg_pool2d(solid, self.cell).reshape(-1) * self.cell**2
        self.register_buffer("rays", rays.permute(2, 0, 1).contiguous())
        self.register_buffer("cell_rays", cell_rays)
        self.register_buffer("solid", solid)
        self.register_buffer("light", torch.tensor(state.light_m, dtype=torch.float64))
        self.cell_planes = CellPlanes(cell_rays, self.rows)
        self.room = Room(state.room, in_world=state.room_axes == "world")
        self.continued: bool = state.continued
        self.in_image: bool = state.room_in_image
        self._lay_patches_beyond(state, pitch)
        self._tabulate_patches()
        self._share_cells(size)

    def _lay_patches_beyond(self, state: SecondBouncesState, pitch: list[float]) -> None:
        """Lay patches beyond the image, four cells wide, where light reaches."""
        slopes = self.cell_rays[:2] / self.cell_rays[2]
        low, high = slopes.amin(1), slopes.amax(1)
        corner = float(self.rays[2].min())
        half = state.light_half_angle_deg
        cosine = corner if half is None else math.cos(math.radians(half))
        further = state.continued or bool(state.room)
        reach = math.sqrt(1 / cosine**2 - 1) if further else 0.0
        border = self.cell * torch.tensor(pitch, dtype=torch.float64)
        width = (4 * border).tolist()
        lines = []
        for axis in (0, 1):
            more = max(0, math.ceil((reach - float(torch.maximum(-low, high)[axis])) / width[axis]))
            inside = max(1, round(float(high[axis] - low[axis] + border[axis]) / width[axis]))
            places = torch.arange(-more, inside + more, dtype=torch.float64) - (inside - 1) / 2
            lines.append((low + high)[axis] / 2 + places * width[axis])
        y, x = torch.meshgrid(lines[1], lines[0], indexing="ij")
        place = torch.stack([x.reshape(-1), y.reshape(-1)])
        outside = ((place < (low - border)[:, None]) | (place > (high + border)[:, None])).any(0)
        ray = nn.functional.normalize(nn.functional.pad(place, (0, 0, 0, 1), value=1.0), dim=0)
        kept = outside & (ray[2] >= cosine) & further
        held = place[:, kept].clamp(low[:, None], high[:, None])
        nearest = torch.cdist(held.T.contiguous(), slopes.T.contiguous()).argmin(1)
        self.register_buffer("out_rays", ray[:, kept])
        self.register_buffer("out_solid", width[0] * width[1] * ray[2, kept] ** 3)
        self.register_buffer("out_from", nearest)

    def _tabulate_patches(self) -> None:
        """Say which patch a direction meets, on an even grid over x / z and y / z."""
        rays = nn.functional.avg_pool2d(self.cell_rays.reshape(3, self.rows, self.columns), 2)
        slopes = (rays[:2] / rays[2]).reshape(2, -1)
        low, high = slopes.amin(1), slopes.amax(1)
        count = torch.tensor([self.columns, self.rows])
        step = ((high - low) / (count - 2).clamp(min=1)).clamp(min=2.0**-23)
        at = [
            low[i] + (torch.arange(int(count[i]), dtype=torch.float64) - 0.5) * step[i]
            for i in (0, 1)
        ]
        y, x = torch.meshgrid(at[1], at[0], indexing="ij")
        places = torch.stack([x.reshape(-1), y.reshape(-1)], dim=1)
        nearest = torch.cdist(places, slopes.T.contiguous()).argmin(1)
        self.register_buffer("table", nearest.reshape(self.rows, self.columns))
        self.table_at: list[float] = [*(low - step).tolist(), *step.tolist()]

    def _share_cells(self, size: tuple[int, int]) -> None:
        """Say which four cells are around a pixel, and their shares in bilinear interpolation."""
        ends = []
        for count, cells in zip(size, (self.rows, self.columns), strict=True):
            at = (torch.arange(count, dtype=torch.float64) + 0.5) / self.cell - 0.5
            first = at.floor().clamp(0, cells - 2)
            ends.append((first.long(), (at - first).clamp(0, 1)))
        (row, down), (column, right) = ends
        corners, shares = [], []
        for i in (0, 1):
            for j in (0, 1):
                corners.append((row + i)[:, None] * self.columns + column + j)
                across = right if j else 1 - right
                shares.append((down if i else 1 - down)[:, None] * across)
        self.register_buffer("corners", torch.stack(corners))
        self.register_buffer("shares", torch.stack(shares).float())

    def forward(self, radial: Tensor, amplitude: Tensor) -> Tensor:
        """Return `removed` of a frame, or of each frame of a batch (B, H, W)."""
        if radial.dim() == 2:
            return self.removed(radial, amplitude)
        if radial.shape[0] == 0:
            return radial
        frames = torch.jit.annotate(list[Tensor], [])
        for i in range(radial.shape[0]):
            self.room.frame = i
            frames.append(self.removed(radial[i], amplitude[i]))
        self.room.frame = 0
        return torch.stack(frames)

    def removed(self, radial: Tensor, amplitude: Tensor, rounds: int = 2) -> Tensor:
        """Return the distances of the direct light, metres (H, W).

        Args:
            radial: Measured, without the camera's own error, metres (H, W).
            amplitude: Measured, the camera's units (H, W).
            rounds: How often the geometry is taken from the distances that were just found.
        """
        measured, strength = self.cells(radial, amplitude)
        shift, planes, large = self.found(measured, strength, rounds)
        shift = shift + self.learned(measured, strength, shift, planes, large)
        return radial - self.in_pixels(shift, radial, shift, planes)

    def learned(
        self, measured: Tensor, strength: Tensor, shift: Tensor, planes: Tensor, large: Tensor
    ) -> Tensor:
        """Return what the remainder takes off besides what `found` returned, metres (N,)."""
        if self.remainder is None:
            return torch.zeros_like(shift)
        read = self.remainder.inputs(*self.read(measured, strength, shift, planes, large))
        return self.remainder(read[None])[0].reshape(-1) * (measured - shift)

    def read(
        self, measured: Tensor, strength: Tensor, shift: Tensor, planes: Tensor, large: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return what a network of the remainder reads, of what `cells` and `found` return."""
        here = torch.stack([measured, shift])
        return here, self.gain * strength, torch.stack([planes, self.cell_rays.to(planes)]), large

    def found(
        self, measured: Tensor, strength: Tensor, rounds: int = 2
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return what second bounces add to the cells' distances, and the planes of the cells.

        Args:
            measured: Distances of the cells (N,), metres.
            strength: Amplitudes of the cells (N,).
            rounds: How often the geometry is taken from the distances that were just found.

        Returns:
            Metres (N,); g of 1 / r = g . ray (3, N); whether a cell is on a large plane (N,).
        """
        turn = torch.zeros(2, len(self.wave_numbers), measured.shape[0]).to(measured)
        turn[0] += 1.0
        here, shift = measured, torch.zeros_like(measured)
        planes, large = self.cell_rays, measured > 0
        for _ in range(rounds):
            planes, fits, large = self.planes(here)
            ratio = self.indirect(planes, fits, large, strength, turn, 1)
            shift = self.shift(ratio)
            here = measured - shift
            turn = self.direct_and(ratio)
            turn = turn / turn.square().sum(0).sqrt()
        return shift, planes, large

    def added(
        self, radial: Tensor, amplitude: Tensor, rounds: int = 4, known: Planes | None = None
    ) -> tuple[Tensor, Tensor]:
        """Return distances and amplitudes with second bounces, (H, W) each.

        Args:
            radial: True distances, metres (H, W).
            amplitude: Of the direct light, the camera's units (H, W).
            rounds: Bounces that are followed, after the direct light.
            known: What `planes` would find; None: it does.
        """
        true, strength = self.cells(radial, amplitude)
        planes, fits, large = self.planes(true) if known is None else known
        turn = torch.zeros(2, len(self.wave_numbers), true.shape[0]).to(true)
        turn[0] += 1.0
        ratio = self.indirect(planes, fits, large, strength, turn, rounds)
        turn = self.direct_and(ratio)
        none = torch.zeros_like(true)
        shift = self.in_pixels(self.shift(ratio), radial, none, planes)
        factor = self.in_pixels(turn.square().sum(0).sqrt().mean(0), radial, none, planes)
        return radial + shift, amplitude * factor

    def direct_and(self, ratio: Tensor) -> Tensor:
        """Return 1 + q, real and imaginary part (2, F, N)."""
        return torch.stack([ratio[0] + 1.0, ratio[1]])

    def shift(self, ratio: Tensor) -> Tensor:
        """Return what ratios q (2, F, N) add to the distance, metres (N,)."""
        total = torch.zeros_like(ratio[0, 0])
        for f, k in enumerate(self.wave_numbers):
            total = total + self.weights[f] * torch.atan2(ratio[1, f], ratio[0, f] + 1.0) / (2 * k)
        return total

    def cells(self, radial: Tensor, amplitude: Tensor) -> tuple[Tensor, Tensor]:
        """Return distance and amplitude of the cells (N,), float64; NaN where most are missing."""
        seen = radial.isfinite() & (radial > 0) & amplitude.isfinite()
        images = torch.stack([1.0 / radial, amplitude, torch.ones_like(radial)])
        images = torch.where(seen, images, 0.0)
        means = nn.functional.avg_pool2d(nn.functional.pad(images, self.pads), self.cell)
        near, strength, share = means.double().reshape(3, -1).unbind(0)
        share = torch.where(share > 0.5, share, torch.full_like(share, math.nan))
        return share / near, strength / share

    def in_pixels(self, values: Tensor, radial: Tensor, shift: Tensor, planes: Tensor) -> Tensor:
        """Interpolate values of cells (N,): between those whose plane a pixel is on.

        Args:
            values: Of the cells.
            radial: Distances of the pixels (H, W), metres.
            shift: What the cells take off the distance before it is on their plane (N,), metres.
            planes: g of the cells (3, N).
        """
        total, weight = torch.zeros_like(radial), torch.zeros_like(radial)
        known = values.isfinite() & planes.isfinite().all(0)
        table = torch.cat([values[None], shift[None], planes])
        table = torch.where(known, table, torch.zeros_like(table)).to(radial.dtype)
        rays = self.rays.to(radial.dtype)
        for i in range(self.corners.shape[0]):
            at = self.corners[i]
            found = table.index_select(1, at.reshape(-1)).reshape(5, radial.shape[0], -1)
            value, off, x, y, z = found.unbind(0)
            off = (radial - off) * (x * rays[0] + y * rays[1] + z * rays[2]) - 1.0
            share = self.shares[i].to(radial.dtype)
            share = share / (1.0 + (3.0 * off / self.off_plane).square())
            total, weight = total + share * value, weight + share
        return torch.where(weight > 0, total / weight, total)

    def planes(self, radial: Tensor) -> Planes:
        """Return g of 1 / r = g . ray of every cell (3, N), which fit a plane, and a large one."""
        planes, fits, large = self.cell_planes(radial)
        if not self.in_image:
            return planes, fits, large
        # A room hides what is behind it: what seems further away, second bounces have shifted.
        room, _ = self.room.met(self.cell_rays.double())
        met = radial * (room * self.cell_rays).sum(0) > 1.0 - self.off_plane
        return torch.where(met, room, planes), fits | met, large | met

    def surfaces(
        self, planes: Tensor, rays: Tensor, solid: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Return place (3, N), normal (3, N), distance and cosine of the light, and area."""
        normal = -planes / planes.square().sum(0).sqrt()
        radial = 1.0 / (planes * rays).sum(0)
        place = rays * radial
        to_light = self.light.double()[:, None] - place
        away = to_light.square().sum(0).sqrt()
        cosine = (normal * to_light).sum(0) / away
        steep = (-(normal * rays).sum(0)).clamp(min=self.steepest)
        return place, normal, away, cosine, solid * radial.square() / steep

    def indirect(
        self,
        planes: Tensor,
        fits: Tensor,
        large: Tensor,
        amplitude: Tensor,
        turn: Tensor,
        rounds: int,
    ) -> Tensor:
        """Return the ratios q of the cells, real and imaginary part (2, F, N).

        Args:
            planes: g of the cells (3, N).
            fits: Which cells are on a plane, and send light (N,).
            large: Which are on a large plane, that goes on beyond the image (N,).
            amplitude: Of the cells (N,).
            turn: What turns the amplitude into the phasor that a cell sends, without the way from
                the light: real and imaginary part (2, F, N).
            rounds: How often the result is put in its place: one more order of bounces each.
        """
        place, normal, away, cosine, area = self.surfaces(
            planes, self.cell_rays.double(), self.solid.double()
        )
        seen = planes.isfinite().all(0) & amplitude.isfinite() & (cosine > self.steepest)
        sends = seen & fits
        strength = torch.where(sends, amplitude * area, 0.0).nan_to_num()
        middle, facing, whole, _ = self.patches(place, normal, area, turn, sends)
        free = self.unhidden(middle, facing, whole)
        start = self.out_from
        shown = amplitude * away.square() / cosine
        table, bright = self.beyond(*self.around(planes, place, shown, sends, large))
        dtype = self.shares.dtype
        here = torch.cat([place, normal]).nan_to_num().to(dtype)
        middle = torch.cat([middle, table[:3]], dim=1).to(dtype)
        facing = torch.cat([facing, table[3:6]], dim=1).to(dtype)
        whole, free = torch.cat([whole, table[6]]).to(dtype), free.to(dtype)
        q = torch.zeros_like(turn)
        for _order in range(rounds):
            light = turned(turn.nan_to_num() * strength, self.wave_numbers, away.nan_to_num())
            beyond = turned(turn[:, :, start].nan_to_num() * bright, self.wave_numbers, table[7])
            light = torch.cat([self.summed(light), beyond], dim=2).to(dtype)
            q = self.gathered(here, middle, facing, whole, light, free).to(place.dtype)
            q = turned(q, [-k for k in self.wave_numbers], away)
            q = torch.where(seen, q * (self.gain * away.square() / cosine), 0.0)
            turn = self.direct_and(q)
        return q

    def around(
        self, planes: Tensor, place: Tensor, bright: Tensor, sends: Tensor, large: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return g (3, M) of what stands beyond the image, and its brightness (M,); 0: nothing.

        Args:
            planes: As in `indirect`.
            place: Of the cells (3, N).
            bright: Their amplitudes at 1 m, seen straight on (N,).
            sends: Which of them send light (N,).
            large: As in `indirect`.
        """
        start = self.out_from
        far, reflectivity = self.room.met(self.out_rays.double())
        known = reflectivity.isfinite()
        far, shown = torch.where(known, far, planes[:, start]), bright[start]
        if self.room.corners.shape[0] > 0:
            # As bright as the cell beside it, or as the cells of its face; if none is, as known.
            on = ((far.T @ place - 1.0).abs() < self.off_plane) & sends
            beside, on = on.gather(1, start[:, None])[:, 0], on.to(bright.dtype)
            of_face = on @ torch.where(sends, bright, 0.0) / on.sum(1)
            given = (reflectivity / (math.pi * self.gain)).nan_to_num(0.0, 0.0)
            of_face = torch.where(of_face.isnan(), given, of_face)
            shown = torch.where(beside | ~known, shown, of_face)
        if self.continued:
            known = known | (sends & large)[start]
        return far, torch.where(known, shown, 0.0)

    def beyond(self, planes: Tensor, brightness: Tensor) -> tuple[Tensor, Tensor]:
        """Return patches beyond the image, and the amplitudes they send, times their areas (M,).

        Args:
            planes: g of 1 / r = g . ray on each of the rays out there (3, M).
            brightness: Amplitudes at 1 m, seen straight on (M,).

        Returns:
            Place, normal, area and distance from the light, one after the other (8, M); zero where
            no light is sent.
        """
        rays = self.out_rays.double()
        place, normal, away, cosine, area = self.surfaces(planes, rays, self.out_solid.double())
        ahead = ((planes * rays).sum(0) > 0) & (cosine > self.steepest) & (brightness != 0)
        table = torch.cat([place, normal, area[None], away[None]])
        sent = brightness * cosine / away.square() * area
        return torch.where(ahead, table, 0.0), torch.where(ahead, sent, 0.0)

    def patches(
        self, place: Tensor, normal: Tensor, area: Tensor, light: Tensor, sends: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return place (3, P), normal (3, P), area (P,) and light (2, F, P) of 2 x 2 cells.

        Args:
            place: Of the cells (3, N).
            normal: Of the cells (3, N).
            area: Of the cells (N,).
            light: That they send, times their area, (2, F, N).
            sends: Which of them count (N,).
        """
        table = torch.where(sends, torch.cat([place * area, normal * area, area[None]]), 0.0)
        table = self.summed(table)
        facing = (table[3:6] / table[3:6].square().sum(0).sqrt()).nan_to_num()
        middle = (table[:3] / table[6]).nan_to_num()
        return middle, facing, table[6], self.summed(torch.where(sends, light, 0.0))

    def summed(self, values: Tensor) -> Tensor:
        """Return sums of values of cells (..., N) over patches, (..., P)."""
        image = values.unflatten(-1, [self.rows, self.columns])
        return 4.0 * nn.functional.avg_pool2d(image, 2).flatten(-2)

    def unhidden(self, place: Tensor, normal: Tensor, area: Tensor) -> Tensor:
        """Return which patches (P, P) nothing stands between, as far as the camera sees."""
        x, y, z = place.float().unbind(0)
        normal = normal.float()
        offset, slack = (place.float() * normal).sum(0), -0.5 * area.float().sqrt()
        low_x, low_y, step_x, step_y = self.table_at
        limit = torch.cat([normal, (offset + slack)[None]]).T.contiguous()
        wide, rows = self.columns // 2, torch.jit.annotate(list[Tensor], [])
        for first in range(0, place.shape[1], wide):
            free = torch.ones(wide, place.shape[1], dtype=torch.bool, device=place.device)
            own = place.float()[:, first : first + wide, None]
            for sample in range(self.samples):  # On the nearer half of the way from i to j.
                t = (sample + 0.5) / (2 * self.samples)
                at_x, at_y = torch.lerp(own[0], x, t), torch.lerp(own[1], y, t)
                at_z = torch.lerp(own[2], z, t).clamp(min=2.0**-23)
                column = ((at_x / at_z - low_x) / step_x).int().clamp(0, self.columns - 1)
                row = ((at_y / at_z - low_y) / step_y).int().clamp(0, self.rows - 1)
                met = self.table.reshape(-1).index_select(
                    0, (row * self.columns + column).reshape(-1)
                )
                plane = limit.index_select(0, met).reshape(wide, -1, 4)
                nx, ny, nz, least = plane.unbind(-1)
                free = free & (at_x * nx + at_y * ny + at_z * nz > least)
            rows.append(free)
        free = torch.cat(rows)
        return free & free.T

    def gathered(
        self, here: Tensor, place: Tensor, normal: Tensor, area: Tensor, light: Tensor, free: Tensor
    ) -> Tensor:
        """Return the light of patches that cells get, (2, F, N).

        Args:
            here: Place and normal of what gets it (6, N), of the cells if some patches are hidden.
            place: Of the patches (3, P), the image's first, then those beyond it.
            normal: Of the patches (3, P).
            area: Of the patches (P,).
            light: That they send, times their area, (2, F, P).
            free: Which patches of the image see each other (P', P'); (0, 0): nothing is hidden.
        """
        count, wide = free.shape[1], 2 * self.columns
        found = [torch.zeros(2, len(self.wave_numbers), 0).to(here)]
        # Row by row of patches: what fits a cache takes half the time.
        for first in range(0, here.shape[1], wide):
            at, up = here[:, first : first + wide].chunk(2)
            kernel, ways = transfer(at, up, place, normal, area)
            if count > 0:
                seen = free[first // 4 : (first + wide) // 4].repeat_interleave(2, 0)
                kernel[:, :count] *= seen.repeat(2, 1)
            sums = []
            for f, k in enumerate(self.wave_numbers):
                c, s = kernel * torch.cos(k * ways), kernel * torch.sin(k * ways)
                real, imaginary = light[0, f], light[1, f]
                sums.append(torch.stack([c @ real - s @ imaginary, c @ imaginary + s @ real]))
            found.append(torch.stack(sums, dim=1))
        return torch.cat(found, dim=2)


def transfer(
    at: Tensor, up: Tensor, place: Tensor, normal: Tensor, area: Tensor
) -> tuple[Tensor, Tensor]:
    """Return which share of its light a patch sends to a point, 1/m^2, and how far it is, (N, P).

    Args:
        at: The points (3, N), metres.
        up: Unit normals there (3, N).
        place: Middles of the patches (3, P).
        normal: Unit normals there (3, P).
        area: Of the patches (P,).
    """
    square = at.square().sum(0)[:, None] + place.square().sum(0) - 2.0 * (at.T @ place)
    square = square.clamp(min=2.0**-23)  # What single precision leaves of one.
    facing = (up.T @ place - (up * at).sum(0)[:, None]).clamp(min=0)
    facing = facing * (at.T @ normal - (place * normal).sum(0)).clamp(min=0)
    return facing / (square * (square + area / math.pi)), square.sqrt()


def turned(phasors: Tensor, wave_numbers: list[float], ways: Tensor) -> Tensor:
    """Return phasors (2, F, N) after a way (N,) in metres more: times exp(i k way)."""
    found = []
    for f, k in enumerate(wave_numbers):
        c, s = torch.cos(k * ways), torch.sin(k * ways)
        real, imaginary = phasors[0, f], phasors[1, f]
        found.append(torch.stack([c * real - s * imaginary, c * imaginary + s * real]))
    return torch.stack(found, dim=1)
