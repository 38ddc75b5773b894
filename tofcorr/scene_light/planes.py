"""Planes of a frame of cells: each cell's own, and large ones that many cells share.

On a plane the inverse distance is linear in the ray: 1 / r = g . ray.
"""

import math

import torch
from torch import Tensor, nn

_ODD = 9.0
"""Variance above which a window is no plane, in those of the noise: three deviations. Chosen."""
WIDE_PLANE = 0.03
"""Share of the distance by which cells of one large plane may miss it: second bounces bend a wall
by that much before they are removed. Set on `benchmarks/scene_light/bounces.py`, building seed."""
_ALIKE = 0.8
"""Least cosine between the normals of cells of one large plane. Set there."""
_LEAST_FACE = 0.005
"""Share of all cells that makes a large plane. Chosen: 15 of 64 x 48."""
_FACES = 12
"""Large planes that are looked for. Chosen."""
STEEPEST = 0.05
"""Least cosine of incidence of what counts as a surface: 87 degrees. Chosen: with 80, twice as much
is left of second bounces in a cupboard, and more pixels of surfaces count as flying."""
OFF_PLANE = 0.01
"""Share of its distance by which a pixel may miss the plane of a cell whose light it gets. Chosen:
three deviations of the noise of cameras."""


class CellPlanes(nn.Module):
    """Finds the planes of the cells of a frame.

    Args:
        rays: Unit directions of the cells (3, N).
        rows: Rows of cells.
    """

    cell_rays: Tensor
    candidates: Tensor

    def __init__(self, rays: Tensor, rows: int) -> None:
        super().__init__()
        self.rows, self.columns = rows, rays.shape[1] // rows
        self.noise: float = OFF_PLANE / 3
        self.odd: float = _ODD
        self.wide_plane: float = WIDE_PLANE
        self.alike: float = _ALIKE
        self.least_face: float = _LEAST_FACE
        self.faces_sought: int = _FACES
        self.register_buffer("cell_rays", rays)
        # As many cells are tried as the smallest of large planes would go into the image.
        spaced = torch.linspace(0, rays.shape[1] - 1, min(round(1 / _LEAST_FACE), rays.shape[1]))
        self.register_buffer("candidates", spaced.long())

    def forward(self, radial: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return g of 1 / r = g . ray of every cell (3, N), which fit a plane, and a large one.

        A cell takes the best window that contains it: of 5 x 5 cells, or of 3 x 3 if those fit no
        plane. If neither does, it takes the normal of a neighbour. Cells on one large plane take
        that plane.
        """
        near = 1.0 / radial
        wide, wide_misfit = self.windows(near, 2)
        small, small_misfit = self.windows(near, 1)
        scale = radial.square().square()
        some = torch.where(small_misfit.isfinite(), small_misfit * scale, math.nan)
        level = self.odd * some.nanmedian() + (self.noise * radial).square()
        flat = wide_misfit * scale < level
        fits = flat | (small_misfit * scale < level)
        planes = torch.where(fits, torch.where(flat, wide, small), math.nan)
        image = nn.functional.pad(
            planes.reshape(3, self.rows, self.columns), [2] * 4, value=math.nan
        )
        around = image.unfold(1, self.rows, 1).unfold(2, self.columns, 1).reshape(3, 25, -1)
        met = (around * self.cell_rays[:, None]).sum(0)
        off = (near / met - 1.0).abs().nan_to_num(math.inf, math.inf)
        nearest = off.argmin(0)[None, None].expand(3, 1, -1)
        beside = around.gather(1, nearest)[:, 0]
        beside = beside * (near / (beside * self.cell_rays).sum(0))
        return self.large_planes(near, torch.where(fits, planes, beside), fits)

    def windows(self, near: Tensor, half: int) -> tuple[Tensor, Tensor]:
        """Return g of the best of nine windows that contain a cell, and its variance (of 1 / r)."""
        seen = near.isfinite()
        near, ray = torch.where(seen, near, 0.0), self.cell_rays.double()
        outer = (ray[:, None] * ray).reshape(9, -1) * seen
        terms = torch.cat([outer, ray * near, near.square()[None], seen.to(near.dtype)[None]])
        size = 2 * half + 1
        image = terms.reshape(1, 14, self.rows, self.columns)
        means = nn.functional.avg_pool2d(image, size, 1, half)[0].reshape(14, -1)
        plane = solved(means[:9].reshape(3, 3, -1), means[9:12])
        count = means[13] * size**2
        misfit = (means[12] - (plane * means[9:12]).sum(0)).clamp(min=0) * size**2 / (count - 3.0)
        misfit = torch.where(count > 3.0 * half + 2.5, misfit, math.inf)  # Twice its unknowns.
        image = torch.cat([plane, misfit[None]]).reshape(4, self.rows, self.columns)
        # Not around the border's cells: any two rows of cells across an edge are on one plane.
        image = nn.functional.pad(image[:, 1:-1, 1:-1], [half + 1] * 4, value=math.inf)
        best, least = torch.zeros_like(plane), torch.full_like(near, math.inf)
        for down in range(0, size, half):
            for right in range(0, size, half):
                tried = image[:, down : down + self.rows, right : right + self.columns]
                tried = tried.reshape(4, -1)
                off = (near - (tried[:3] * ray).sum(0)).square() + tried[3]
                better = off < least
                best = torch.where(better, tried[:3], best)
                least = torch.where(better, off, least)
        return best, torch.where(seen, least, math.inf)

    def large_planes(
        self, near: Tensor, own: Tensor, fits: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Give cells that lie on one large plane that plane: the largest first."""
        ray, size = self.cell_rays.double(), self.least_face * near.shape[0]
        normal = own / own.square().sum(0).sqrt()
        free, best = fits & own.isfinite().all(0), own
        left = torch.full_like(near, math.inf)
        seeds = own[:, self.candidates]
        tried, toward = seeds.float(), normal[:, self.candidates].float()
        alike = ((tried.T @ ray.float()) / near.float() - 1.0).abs() < self.wide_plane
        alike = (alike & (toward.T @ normal.float() > self.alike)).float()
        for _ in range(self.faces_sought):
            most = (alike @ free.to(alike.dtype)).argmax()
            member, plane, off = (alike[most] > 0) & free, seeds[:, most], left
            for _again in range(2):
                weight = torch.where(member, near.square().reciprocal(), 0.0)
                rows = ray * weight
                right = rows @ torch.where(member, near * weight, 0.0)
                plane = solved((rows @ rows.T)[:, :, None], right[:, None])[:, 0]
                facing = plane / plane.square().sum().sqrt()
                off = ((plane @ ray) / near - 1.0).abs()
                member = free & (off < self.wide_plane) & (facing @ normal > self.alike)
            member = member & (member.sum() > size)
            spread = nn.functional.max_pool2d(
                member.to(near.dtype).reshape(1, self.rows, self.columns), 5, 1, 2
            )
            beside = (spread.reshape(-1) > 0) & (off < self.wide_plane) & (off < left)
            chosen = member | (beside & ~fits)
            best = torch.where(chosen, plane[:, None], best)
            left = torch.where(chosen, off, left)
            free = free & ~member
        return best, fits | left.isfinite(), left.isfinite()


def solved(matrix: Tensor, right: Tensor) -> Tensor:
    """Solve symmetric equations (3, 3, N) x = (3, N) by determinants; NaN if they are singular."""
    a, b, c = matrix.unbind(0)
    rows = [torch.linalg.cross(b, c, dim=0), torch.linalg.cross(c, a, dim=0)]
    rows.append(torch.linalg.cross(a, b, dim=0))
    determinant = (a * rows[0]).sum(0)
    return torch.stack([(row * right).sum(0) for row in rows]) / determinant
