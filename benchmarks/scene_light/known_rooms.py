"""What a room gives to the removal of second bounces: given as faces, as a mesh, or recorded.

    python -m benchmarks.scene_light.known_rooms --seed 1

Gain and base error are the true ones. The recorded room of a frame is that of the other frames.
"""

import argparse
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.renewed.rendering import start_renderer
from benchmarks.scene_light.bounces import WALLS, camera, measured, on_planes, share
from benchmarks.scene_light.rooms import CONE, FREQUENCY, GAIN, SCENES, rendered
from tofcorr.scene_light.bounces import SecondBounces, SecondBouncesState
from tofcorr.training.scene import recorded_room

ROOMS = ("wall_and_floor", "wall_and_side", "cupboard", "boxes")
KINDS = ("none", "given", "mesh", "off", "recorded")
OFF = 0.01  # metres in x, y and z by which a room is off: 17 mm
Image = np.ndarray


def faces_of(name: str, seed: int, views: int) -> tuple[list[dict[str, Any]], torch.Tensor]:
    """The panels of a scene, of boxes the walls alone, and world_from_camera (views, 4, 4)."""
    start_renderer()
    parts, poses = SCENES[name](np.random.default_rng([seed, *name.encode()]), views)
    square, faces = np.array([[-1, -1, 0, 1], [1, -1, 0, 1], [1, 1, 0, 1], [-1, 1, 0, 1.0]]), []
    for part in parts.values():
        if part["type"] == "rectangle":
            corners = square @ np.array(part["to_world"].matrix).T
            faces.append({"corners": corners[:, :3].tolist()})
    return faces, torch.tensor(np.stack(poses))


def meshed(faces: list[dict[str, Any]], file: Path) -> dict[str, Any]:
    """Write faces as a mesh of many triangles, in millimetres; return what names it."""
    import trimesh

    meshes = []
    for face in faces:
        corners = 1e3 * np.array(face["corners"])
        meshes.append(trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]]).subdivide().subdivide())
    trimesh.util.concatenate(meshes).export(file)
    return {"file": str(file), "scale": 1e-3}


def bounces(**room: object) -> SecondBounces:
    """The camera's, with its true gain."""
    values = {"frequencies_hz": [FREQUENCY], "gain": 1 / GAIN, "light_half_angle_deg": CONE}
    return SecondBounces(camera(), SecondBouncesState.model_validate(values | room)).double()


def rows_of(name: str, seed: int, views: int) -> dict[str, list[tuple[Image, ...]]]:
    """Errors before and after, plain and after a plane fit, of each frame by kind of room."""
    draw, none = np.random.default_rng(seed + 1), bounces()
    faces, poses = faces_of(name, seed, views)
    frames = rendered(name, seed, views)
    seen, rows = (
        [measured(one, draw, lambda distance, _: 0.0 * distance) for one in frames],
        {kind: [] for kind in KINDS},
    )
    moved = [{"corners": (np.array(f["corners"]) + OFF).tolist()} for f in faces]
    with tempfile.TemporaryDirectory() as folder:
        mesh = bounces(room=meshed(faces, Path(folder) / "room.ply"))
    fixed = {"none": none, "mesh": mesh, "given": bounces(room=faces), "off": bounces(room=moved)}
    for number, (frame, (distance, light)) in enumerate(zip(frames, seen, strict=True)):
        others = [k for k in range(views) if k != number]
        found = recorded_room(none, [seen[k] for k in others], poses[others])
        beyond = {"room_in_image": False, "room": [one.to_mapping() for one in found]}
        for kind, own in {**fixed, "recorded": bounces(**beyond)}.items():
            own.room.set_pose(poses[number])
            removed = (distance - own(distance, light)).numpy()
            used = np.isfinite(frame.error) & np.isfinite(removed)
            if name in WALLS:  # On the wall, the largest surface.
                used &= frame.shape == np.bincount(frame.shape[used]).argmax()
            before = np.where(used, frame.error, np.nan)
            flat = [on_planes(frame, image, used) for image in (before, before - removed)]
            rows[kind].append((before, before - removed, *flat))
    return rows


def main() -> None:
    """Print the table: percent of the squared error removed, and after a plane fit."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, required=True, nargs="+")
    parser.add_argument("--views", type=int, default=4)
    parser.add_argument("--scene", choices=ROOMS, nargs="*", default=ROOMS)
    options = parser.parse_args()
    torch.set_num_threads(1)
    print(f"{'':16}" + "".join(f"{kind:>16}" for kind in KINDS))
    for name in options.scene:
        every: dict[str, list[tuple[Image, ...]]] = {kind: [] for kind in KINDS}
        for seed in options.seed:
            for kind, own in rows_of(name, seed, options.views).items():
                every[kind] += own
        line = f"{name:16}"
        for kind in KINDS:
            before, after, *flat = (np.stack(images) for images in zip(*every[kind], strict=True))
            line += f"{share(before, after):9.1f},{share(*flat):6.1f}"
        print(line, flush=True)


if __name__ == "__main__":
    main()
