"""The target's reflectivity, and what stands around it."""

from dataclasses import dataclass

import numpy as np

from benchmarks.renewed.generator.design import Design
from benchmarks.renewed.transport.rooms import Room
from benchmarks.withheld.generator.rigid import Array

WHITE = 0.8


@dataclass(frozen=True)
class Surface:
    """The target is z = 0, seen from positive z; a board of `half` sizes, or endless walls."""

    room: Room
    half: tuple[float, float]  # of a board, metres; infinite for a wall
    behind: float  # metres from the board back to the wall
    square: float  # metres: the side of a square, or the size of a texture's grain
    dark: float
    waves: Array  # (6, 3): of the texture
    kind: tuple[str, ...]  # of every frame: white, checkerboard, grey or texture

    def reflectivity(self, x: Array, y: Array) -> Array:
        """Reflectivity (N, H, W) of the target at its coordinates (N, H, W), metres."""
        result = np.full(x.shape, WHITE)
        for name in set(self.kind):
            frames = np.array([one == name for one in self.kind])
            result[frames] = self._pattern(name, x[frames], y[frames])
        return result

    def _pattern(self, name: str, x: Array, y: Array) -> Array:
        u, v = np.floor(x / self.square), np.floor(y / self.square)
        if name == "checkerboard":
            return np.where((u + v) % 2 > 0, WHITE, self.dark)
        if name == "grey":
            step = (u + 2 * v) % 5 / 4
            return self.dark + (WHITE - self.dark) * step
        if name == "texture":
            wave = sum(np.sin((a * x + b * y) / self.square + c) for a, b, c in self.waves) / 6
            return np.clip(0.45 + 0.5 * wave, 0.08, WHITE)
        return np.full(x.shape, WHITE)


def draw_room(rng: np.random.Generator, design: Design) -> Room:
    """Draw the walls of a design."""
    middle = float(np.sqrt(design.near * design.far))
    low, left = middle * rng.uniform(0.3, 0.6, 2)
    side = float(left * rng.choice([-1.0, 1.0]))
    closed, corner = design.scene == "closed", design.scene in ("corner", "closed")
    return Room(
        floor=-float(low) if corner or design.scene == "floor" else None,
        side=side if corner else None,
        other_side=-np.sign(side) * design.far * rng.uniform(0.8, 1.2) if closed else None,
        ceiling=design.far * rng.uniform(0.8, 1.2) if closed else None,
        back=design.far * rng.uniform(1.3, 1.6) if closed else None,
        target_albedo=WHITE,
    )


def draw_surface(
    rng: np.random.Generator, design: Design, room: Room, pose_id: np.ndarray
) -> Surface:
    """Draw the target of a design."""
    middle = float(np.sqrt(design.near * design.far))
    half = middle * rng.uniform(0.3, 0.6, 2)
    if design.scene != "board":
        half = np.full(2, np.inf)
    names = (design.target,) if design.target != "both" else ("white", "checkerboard")
    per_pose = rng.integers(len(names), size=int(pose_id[-1]) + 1)
    return Surface(
        room=room,
        half=(float(half[0]), float(half[1])),
        behind=rng.uniform(0.15, 0.8) * middle,
        square=middle * rng.uniform(0.06, 0.15),
        dark=rng.uniform(0.06, 0.2),
        waves=np.column_stack([rng.normal(0, 2, (6, 2)), rng.uniform(0, 6, 6)]),
        kind=tuple(names[per_pose[i]] for i in pose_id),
    )
