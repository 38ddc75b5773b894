"""What was recorded in a room, as files of the formats that other programs write."""

import csv
import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import yaml
from importing.posed_scene import Recorded
from scipy.spatial.transform import Rotation

from tofcorr.examples import files


def write_png(recorded: Recorded, folder: Path, *, swap_bytes: bool = False, turn: int = 0) -> None:
    """Write `depth/STAMP.png` in millimetres and `ir/STAMP.png`."""
    depth = recorded.depth_mm.byteswap() if swap_bytes else recorded.depth_mm
    turned = [np.rot90(images, turn, axes=(1, 2)) for images in (depth, recorded.amplitude)]
    images = replace(recorded, depth_mm=turned[0], amplitude=turned[1])
    files.write_png(images, folder, [f"{stamp:.6f}" for stamp in recorded.image_times])


def write_numbered(recorded: Recorded, folder: Path, ending: str) -> None:
    """Write `depth/0.npy`, ... or `depth/0.tiff`, ... in metres, and `ir` as counts."""
    for kind, images in (("depth", recorded.depth_mm), ("ir", recorded.amplitude)):
        (folder / kind).mkdir(parents=True)
        for number, image in enumerate(images):
            path = folder / kind / f"{number}.{ending}"
            written = (image / 1e3).astype(np.float32) if kind == "depth" else image
            (np.save if ending == "npy" else cv2.imwrite)(str(path), written)


def write_images(recorded: Recorded, folder: Path, ending: str) -> None:
    """Write PNG by their times, or others by their numbers."""
    if ending == "png":
        write_png(recorded, folder)
    else:
        write_numbered(recorded, folder, ending)


def write_csv(poses: np.ndarray, path: Path) -> Path:
    """Write a table of image names, millimetres and rotation vectors."""
    turns = Rotation.from_matrix(poses[:, :3, :3]).as_rotvec()
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["image", "tx_mm", "ty_mm", "tz_mm", "rx", "ry", "rz"])
        for number, (pose, turn) in enumerate(zip(poses, turns, strict=True)):
            writer.writerow([f"{number}.npy", *(1e3 * pose[:3, 3]), *turn])
    return path


def write_moveit(poses: np.ndarray, path: Path) -> Path:
    """Write samples as MoveIt's hand-eye calibration does."""
    other = np.eye(4).ravel().tolist()
    samples = [
        {"effector_wrt_world": pose.ravel().tolist(), "object_wrt_sensor": other} for pose in poses
    ]
    path.write_text(yaml.safe_dump(samples), encoding="utf-8")
    return path


def write_bop(recorded: Recorded, folder: Path, *, poses: bool = True) -> Path:
    """Write a BOP scene: scene_camera.json, depth/000000.png, gray/000000.png."""
    cameras = {}
    for kind in ("depth", "gray"):
        (folder / kind).mkdir(parents=True)
    for number, pose in enumerate(recorded.exact @ recorded.tool_from_camera):
        camera_from_world = np.linalg.inv(pose)
        cameras[str(number)] = {"cam_K": recorded.matrix.ravel().tolist(), "depth_scale": 0.1}
        if poses:
            cameras[str(number)] |= {
                "cam_R_w2c": camera_from_world[:3, :3].ravel().tolist(),
                "cam_t_w2c": (1e3 * camera_from_world[:3, 3]).tolist(),
            }
        cv2.imwrite(
            str(folder / "depth" / f"{number:06d}.png"),
            (10 * recorded.depth_mm[number].astype(np.uint32)).astype(np.uint16),
        )
        cv2.imwrite(str(folder / "gray" / f"{number:06d}.png"), recorded.amplitude[number])
    (folder / "scene_camera.json").write_text(json.dumps(cameras), encoding="utf-8")
    return folder
