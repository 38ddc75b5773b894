"""Planes of a frame of cells: each cell's own, and large ones that many cells share.

On a plane the inverse distance is linear in the ray: 1 / r = g . ray.
"""

import math

import torch
from torch import Tensor, nn

OFF_PLANE = 0.03
"""Share of its distance by which something may miss its plane, three standard deviations. Second
bounces bend a wall by that much before they are removed. Set on building seeds of
`benchmarks/scene_light/bounces.py`."""
WINDOW = 5
"""Cells on a side of the windows that planes are sought in; where those fit none, 3. Chosen."""
STEEPEST = 0.05
"""Least cosine of incidence of what counts as a surface: 87 degrees. Chosen: with 80, twice as much
is left of second bounces in a cupboard, and more pixels of surfaces count as flying."""


class CellPlanes(nn.Module):
    """Finds the planes of the cells of a frame.

    A cell takes the best window that contains it: of 5 x 5 cells, or of 3 x 3 if those fit no
    plane. Cells on a plane that is larger than the small window take that plane: the largest that
    they are on. Their normal is nearer to that of the plane than to one at a right angle to it.

    Args:
        rays: Unit directions of the cells (3, N).
        rows: Rows of cells.
    """

    cell_rays: Tensor
    candidates: Tensor

    def __init__(self, rays: Tensor, rows: int) -> None:
        super().__init__()
        self.rows, self.columns = rows, rays.shape[1] // rows
        self.off_plane: float = OFF_PLANE
        self.side: int = WINDOW
        self.least: int = 3**2
        self.register_buffer("cell_rays", rays)
        # As many cells are tried as small windows go into the image.
        spaced = torch.linspace(0, rays.shape[1] - 1, max(1, rays.shape[1] // self.least))
        self.register_buffer("candidates", spaced.long())

    def forward(self, radial: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return g of every cell (3, N), which are on a plane, and on a large one (N,).

        Args:
            radial: Distances of the cells (N,), metres.
        """
        near, ray = 1.0 / radial, self.cell_rays.double()
        wide, wide_misfit = self.windows(near, self.side // 2)
        small, small_misfit = self.windows(near, 1)
        scale = radial.square().square()
        some = torch.where(small_misfit.isfinite(), small_misfit * scale, math.nan)
        level = some.nanmedian() + (self.off_plane / 3 * radial).square()
        flat = wide_misfit * scale < level
        fits = flat | (small_misfit * scale < level)
        planes = torch.where(fits, torch.where(flat, wide, small), math.nan)
        shared = self.large_planes(near, planes)
        large = shared[0].isfinite()
        # Other cells take the plane beside them that comes nearest, moved to where they are unless
        # they are on it.
        planes = torch.where(large, shared, planes)
        image = torch.cat([planes, large.to(near.dtype)[None]]).reshape(4, self.rows, -1)
        image = nn.functional.pad(image, [self.side // 2] * 4, value=math.nan)
        around = image.unfold(1, self.rows, 1).unfold(2, self.columns, 1)
        around = around.reshape(4, self.side * self.side, -1)
        off = ((around[:3] * ray[:, None]).sum(0) / near - 1.0).abs()
        least, nearest = off.nan_to_num(math.inf, math.inf).min(0)
        beside = around.gather(1, nearest[None, None].expand(4, 1, -1))[:, 0]
        joins = ~fits & (beside[3] > 0) & (least < self.off_plane)
        moved = beside[:3] * (near / (beside[:3] * ray).sum(0))
        others = torch.where(joins, beside[:3], moved)
        return torch.where(fits, planes, others), fits | joins, large | joins

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
        misfit = torch.where(means[13] > 0.5, misfit, math.inf)  # Of most of its cells.
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

    def large_planes(self, near: Tensor, own: Tensor) -> Tensor:
        """Return the plane of cells that lie on one with many others (3, N); NaN elsewhere.

        Args:
            near: One over the distance of the cells (N,).
            own: g of the cells, NaN where they fit none (3, N).
        """
        ray, tried = self.cell_rays.double(), own[:, self.candidates]
        best, free = torch.full_like(own, math.nan), own[0].isfinite()
        alike = self.on(tried, near, own).float()
        votes = alike @ free.float()
        while bool(votes.max() > self.least):  # The largest first; each is tried once.
            most = votes.argmax()
            member, plane = (alike[most] > 0) & free, tried[:, most]
            for _ in range(2):
                weight = torch.where(member, near.square().reciprocal(), 0.0)
                rows = ray * weight
                right = rows @ torch.where(member, near * weight, 0.0)
                plane = solved((rows @ rows.T)[:, :, None], right[:, None])[:, 0]
                member = free & self.on(plane[:, None], near, own)[0]
            member = member & (member.sum() > self.least)
            best, free = torch.where(member, plane[:, None], best), free & ~member
            alike[most] = 0.0
            votes = alike @ free.float()
        return best

    def on(self, planes: Tensor, near: Tensor, own: Tensor) -> Tensor:
        """Return which cells, of planes `own` (3, N), are on planes (3, C): (C, N)."""
        met = (planes.T @ self.cell_rays.double() / near - 1.0).abs() < self.off_plane
        normal = own / own.square().sum(0).sqrt()
        facing = planes / planes.square().sum(0).sqrt()
        return met & (facing.T @ normal > 0.5**0.5)


def solved(matrix: Tensor, right: Tensor) -> Tensor:
    """Solve symmetric equations (3, 3, N) x = (3, N) by determinants; NaN if they are singular."""
    a, b, c = matrix.unbind(0)
    rows = [torch.linalg.cross(b, c, dim=0), torch.linalg.cross(c, a, dim=0)]
    rows.append(torch.linalg.cross(a, b, dim=0))
    determinant = (a * rows[0]).sum(0)
    return torch.stack([(row * right).sum(0) for row in rows]) / determinant
