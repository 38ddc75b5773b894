# pyright: reportMissingImports=false
"""Rooms around a target, as a Mitsuba scene: the target is z = 0, seen from positive z, y up."""

from dataclasses import dataclass
from typing import Any

import numpy as np

REACH = 12.0  # metres that floor, walls and target extend; beyond every camera of the ranges


@dataclass(frozen=True)
class Room:
    """What stands around the target; None where there is nothing.

    Attributes:
        floor: Height y of the floor, metres below the target's origin (negative).
        side: Position x of a side wall; its sign says on which side it stands.
        other_side: Position x of a second side wall.
        ceiling: Height y of the ceiling.
        back: Distance z of a wall behind the camera.
        target_albedo: Reflectivity of the target.
        albedo: Reflectivity of everything else.
        gloss: Roughness of a glossy side wall, or 0 where it is diffuse.
    """

    floor: float | None = None
    side: float | None = None
    other_side: float | None = None
    ceiling: float | None = None
    back: float | None = None
    target_albedo: float = 0.7
    albedo: float = 0.5
    gloss: float = 0.0


def scene_of(room: Room, camera: np.ndarray) -> dict[str, Any]:
    """Mitsuba's description of a room, lit by a spot at the camera (target_from_camera, 4x4)."""
    import mitsuba as mi

    diffuse = {"type": "diffuse", "reflectance": {"type": "rgb", "value": room.albedo}}
    parts: dict[str, Any] = {
        "type": "scene",
        "integrator": {"type": "transient_path", "max_depth": 8, "rr_depth": 5},
        "light": spot_at(camera),
        "target": {
            "type": "rectangle",
            "to_world": mi.ScalarTransform4f().scale(REACH),
            "bsdf": {
                "type": "diffuse",
                "reflectance": {"type": "rgb", "value": room.target_albedo},
            },
        },
    }
    for name, axis, position, facing in _walls(room):
        shiny = name == "side" and room.gloss > 0
        parts[name] = {
            "type": "rectangle",
            "to_world": mi.ScalarTransform4f(_placed(axis, position, facing).tolist()),
            "bsdf": _glossy(room) if shiny else diffuse,
        }
    return parts


def spot_at(camera: np.ndarray) -> dict[str, Any]:
    """The camera's own light: a cone of 100 degrees that fades towards its rim."""
    import mitsuba as mi

    return {
        "type": "spot",
        "to_world": mi.ScalarTransform4f(camera.tolist()),
        "intensity": {"type": "rgb", "value": 1.0},
        "cutoff_angle": 50.0,
        "beam_width": 38.0,
    }


def _glossy(room: Room) -> dict[str, Any]:
    return {
        "type": "roughplastic",
        "distribution": "ggx",
        "alpha": room.gloss,
        "diffuse_reflectance": {"type": "rgb", "value": room.albedo},
    }


def _walls(room: Room) -> list[tuple[str, int, float, float]]:
    """Name, axis, position and direction of the normal of every wall that is there."""
    found: list[tuple[str, int, float, float]] = []
    if room.floor is not None:
        found.append(("floor", 1, room.floor, 1.0))
    if room.ceiling is not None:
        found.append(("ceiling", 1, room.ceiling, -1.0))
    if room.side is not None:
        found.append(("side", 0, room.side, -float(np.sign(room.side))))
    if room.other_side is not None:
        found.append(("other_side", 0, room.other_side, -float(np.sign(room.other_side))))
    if room.back is not None:
        found.append(("back", 2, room.back, -1.0))
    return found


def _placed(axis: int, position: float, facing: float) -> np.ndarray:
    """Transform (4, 4) of the unit square, whose normal is z, to a wall across an axis."""
    normal = np.zeros(3)
    normal[axis] = facing
    along = np.roll(np.abs(normal), 1)
    result = np.eye(4)
    result[:3, :3] = REACH * np.stack([along, np.cross(normal, along), normal], axis=1)
    result[axis, 3] = position
    return result
