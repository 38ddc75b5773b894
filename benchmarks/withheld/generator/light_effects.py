"""Effects of light that came another way, or of light that was there already."""

import numpy as np

from benchmarks.withheld.generator.effect import Effect
from benchmarks.withheld.generator.observe import View, background
from benchmarks.withheld.generator.rigid import Array, inverse

COARSE = 4  # pixels between the points at which indirect light is summed


def ambient_light(rng: np.random.Generator) -> Effect:
    """Background light leaves a small false correlation: the taps of a pixel do not match."""
    mismatch = np.exp(1j * rng.choice([-1, 1]) * rng.uniform(1.3, 1.9))

    def change(strength: float, view: View, phasor: np.ndarray) -> np.ndarray:
        reference = np.exp(2j * np.pi * 1.25 / view.world.camera.unambiguous_range)
        return phasor + strength * background(view) * reference * mismatch

    return Effect("ambient_light", "light", change, 0.02)


def mixed_pixels(rng: np.random.Generator) -> Effect:
    """Slits along every edge of the pattern show what lies behind the board."""
    width, share = rng.uniform(0.006, 0.012), rng.uniform(0.4, 0.7)

    def change(strength: float, view: View, phasor: np.ndarray) -> np.ndarray:
        along = np.gradient(view.x, axis=2), np.gradient(view.y, axis=2)
        down = np.gradient(view.x, axis=1), np.gradient(view.y, axis=1)
        seen = np.zeros_like(view.x)
        for u in (-1 / 3, 0, 1 / 3):
            for v in (-1 / 3, 0, 1 / 3):
                x, y = view.x + u * along[0] + v * down[0], view.y + u * along[1] + v * down[1]
                seen += share * np.exp(-((view.world.target.edge_distance(x, y) / width) ** 2)) / 9
        turn = np.exp(2j * np.pi * strength / view.world.camera.unambiguous_range)
        return phasor * (1 - seen + seen * turn)

    return Effect("mixed_pixels", "light", change, 0.05)


def multipath(rng: np.random.Generator) -> Effect:
    """A side wall and a floor send light on to the target: a sum of phasors over their patches."""
    side, wall, floor = rng.choice([-1.0, 1.0]), rng.uniform(0.95, 1.2), rng.uniform(0.9, 1.1)
    patch = (np.arange(4) + 0.5) / 4
    a, b = (grid.ravel() for grid in np.meshgrid(patch, patch))
    on_wall = np.stack([np.full(16, side * wall), 2 * a - 1, 1.3 * b + 0.02], -1)
    on_floor = np.stack([2 * wall * a - wall, np.full(16, -floor), 1.3 * b + 0.02], -1)
    points = np.concatenate([on_wall, on_floor])
    normals = np.repeat([[-side, 0.0, 0.0], [0.0, 1.0, 0.0]], 16, axis=0)
    area = 2 * 1.3 / 16

    def change(strength: float, view: View, phasor: np.ndarray) -> np.ndarray:
        world = view.world
        camera = (
            inverse(world.setup.world_from_target)
            @ world.world_from_tool()
            @ world.setup.tool_from_camera
        )[:, :3, 3]
        lit = points - camera[:, None]  # (N, K, 3)
        first = np.linalg.norm(lit, axis=-1)
        irradiance = np.maximum(-(lit * normals).sum(-1) / first, 0.0) / first**2
        rows, columns = _coarse(view.x.shape[1]), _coarse(view.x.shape[2])
        at = np.ix_(np.arange(world.frames), rows, columns)
        x, y, direct = view.x[at], view.y[at], view.distance[at]
        dx, dy, dz = (
            points.T[i] - part[..., None] for i, part in enumerate((x, y, np.zeros_like(x)))
        )
        second = np.sqrt(dx * dx + dy * dy + dz * dz)
        leaving = np.maximum(-(dx * normals[:, 0] + dy * normals[:, 1]) / second, 0.0)
        weight = (
            irradiance[:, None, None]
            * leaving
            * dz
            / second
            * area
            / (np.pi * np.maximum(second, 0.15) ** 2)
        )
        longer = (first[:, None, None] + second - direct[..., None]) / 2
        turn = np.exp(2j * np.pi / world.camera.unambiguous_range * longer)
        ratio = (weight * turn).sum(-1) * direct**2 / view.cosine[at]
        return phasor * (1 + strength * _refined(ratio, rows, columns, view.x.shape))

    return Effect("multipath", "light", change, 0.3)


def stray_light(rng: np.random.Generator) -> Effect:
    """Light scattered between lens and sensor: the image convolved with a heavy-tailed spread."""
    width, power = rng.uniform(3.0, 8.0), rng.uniform(1.1, 1.6)

    def change(strength: float, view: View, phasor: np.ndarray) -> np.ndarray:
        height, columns = phasor.shape[1:]
        size = (2 * height, 2 * columns)
        row, column = (
            np.minimum(np.arange(size[0]), size[0] - np.arange(size[0])),
            np.arange(size[1]),
        )
        column = np.minimum(column, size[1] - column)
        spread = (1 + (row[:, None] ** 2 + column**2) / width**2) ** -power
        spread /= spread.sum()
        scattered = np.fft.ifft2(np.fft.fft2(phasor, size) * np.fft.fft2(spread))[
            :, :height, :columns
        ]
        return (1 - strength) * phasor + strength * scattered

    return Effect("stray_light", "light", change, 0.05)


def _coarse(size: int) -> np.ndarray:
    return np.unique(np.append(np.arange(0, size, COARSE), size - 1))


def _refined(
    values: np.ndarray, rows: np.ndarray, columns: np.ndarray, shape: tuple[int, ...]
) -> np.ndarray:
    """Bilinear interpolation (N, H, W) of values on the coarse rows and columns."""
    return np.einsum(
        "hr,nrc,wc->nhw", _hats(rows, shape[1]), values, _hats(columns, shape[2]), optimize=True
    )


def _hats(knots: np.ndarray, size: int) -> Array:
    return np.stack([np.interp(np.arange(size), knots, row) for row in np.eye(len(knots))], axis=1)
