"""Targets: what other programs write, and importers read."""

import json
import random
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from PIL import Image
from scipy.spatial.transform import Rotation

from benchmarks.fuzzing.mutations import HOSTILE, change_bytes, change_tree
from benchmarks.fuzzing.target import SilentlyDifferentError, Target
from tofcorr.errors import TofcorrError
from tofcorr.importing.bop.scene import read_scene_camera
from tofcorr.importing.distances.readings import read_distances
from tofcorr.importing.images import read_array, read_grey
from tofcorr.importing.intrinsics import read_intrinsics
from tofcorr.importing.pose_files import read_poses
from tofcorr.importing.run import RefusedViewError

_K = [[365.5, 0.0, 255.5], [0.0, 366.5, 205.0], [0.0, 0.0, 1.0]]
_LENS = [0.09, -0.27, 0.0, 0.001, 0.095]

_MATRIX = " ".join(map(str, np.ravel(_K)))
_OPENCV_YAML = f"""%YAML:1.0
---
image_width: 512
image_height: 424
cameraMatrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: {np.ravel(_K).tolist()}
distortionCoefficients: !!opencv-matrix
   rows: 1
   cols: 5
   dt: d
   data: {_LENS}
"""
_OPENCV_XML = f"""<?xml version="1.0"?>
<opencv_storage>
<image_width>512</image_width>
<image_height>424</image_height>
<cameraMatrix type_id="opencv-matrix">
  <rows>3</rows><cols>3</cols><dt>d</dt>
  <data>{_MATRIX}</data></cameraMatrix>
</opencv_storage>
"""


def targets(folder: Path, seed: int) -> list[Target]:
    """Return the targets; what they mutate is written into a folder."""
    generator = np.random.default_rng(seed)
    found = [Target(f"poses, {p.name}", 2.5, _poses(p)) for p in _pose_files(folder, generator)]
    found += [Target(f"intrinsics, {p.name}", 1.5, _lens(p)) for p in _lens_files(folder)]
    found.append(Target("scene_camera.json", 4, _bop))
    found += [Target(f"image, {p.name}", 1.5, _image(p)) for p in _image_files(folder, generator)]
    found.append(Target("distances", 3, _distances))
    return found


def _pose_files(folder: Path, generator: np.random.Generator) -> list[Path]:
    poses = np.tile(np.eye(4), (6, 1, 1))
    poses[:, :3, :3] = Rotation.from_quat(generator.normal(size=(6, 4))).as_matrix()
    poses[:, :3, 3] = generator.normal(size=(6, 3))
    turns = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    rows = np.column_stack([0.1 * np.arange(6), poses[:, :3, 3], turns])
    np.savetxt(folder / "tum.txt", rows, fmt="%.9f")
    head = "timestamp_s,tx,ty,tz,qx,qy,qz,qw"
    np.savetxt(folder / "poses.csv", rows, fmt="%.9f", delimiter=",", header=head, comments="")
    np.savetxt(folder / "matrices.txt", poses.reshape(6, 16))
    np.save(folder / "poses.npy", poses)
    samples = [{"effector_wrt_world": pose.ravel().tolist()} for pose in poses]
    (folder / "samples.yaml").write_text(yaml.safe_dump(samples), encoding="utf-8")
    names = ("tum.txt", "poses.csv", "matrices.txt", "poses.npy", "samples.yaml")
    return [folder / name for name in names]


def _poses(source: Path) -> Callable[[random.Random, Path], object]:
    content = source.read_bytes()

    def attempt(generator: random.Random, folder: Path) -> object:
        path = folder / source.name
        path.write_bytes(_change_text(content, generator, source.suffix))
        track = read_poses(path)
        if source.name == "tum.txt":
            # With digits alone another reader understands it the same way.
            text = path.read_text("utf-8-sig")
            if set(text) <= set("0123456789.e+- \n"):
                stated = np.array([line.split() for line in text.splitlines() if line.split()])
                values = stated.astype(float)
                assert track.timestamp is not None
                found = np.column_stack([track.timestamp, track.world_from_tool[:, :3, 3]])
                kept = values[np.append(True, np.diff(values[:, 0]) != 0)][:, :4]
                if found.shape != kept.shape or not np.array_equal(found, kept):
                    raise SilentlyDifferentError("poses: other numbers than the cells")
        return track

    return attempt


def _change_text(content: bytes, generator: random.Random, suffix: str) -> bytes:
    if suffix in (".yaml", ".json") and generator.random() < 0.6:
        tree = change_tree(yaml.safe_load(content), generator)
        return yaml.safe_dump(tree, allow_unicode=True).encode("utf-8", "surrogatepass")
    if suffix in (".txt", ".csv") and generator.random() < 0.5:
        rows = [line.replace(",", " , ").split() for line in content.decode().splitlines()]
        row = generator.choice(rows)
        row[generator.randrange(len(row))] = str(generator.choice(HOSTILE))
        return "\n".join(map(" ".join, rows)).encode("utf-8", "surrogatepass")
    return change_bytes(content, generator)


def _lens_files(folder: Path) -> list[Path]:
    texts = {
        "own.yaml": f"width: 512\nheight: 424\nK: {_K}\ndistortion: {_LENS}\n",
        "recording.yaml": f"camera: {{width: 512, height: 424, K: {_K}, distortion: {_LENS}}}\n",
        "ros.yaml": f"image_width: 512\nimage_height: 424\ncamera_matrix: {{rows: 3, cols: 3, "
        f"data: {np.ravel(_K).tolist()}}}\ndistortion_model: plumb_bob\n"
        f"distortion_coefficients: {{rows: 1, cols: 5, data: {_LENS}}}\n",
        "numbers.json": json.dumps({"width": 512, "height": 424, "camera_matrix": _K}),
        "kalibr.yaml": "cam0:\n  camera_model: pinhole\n  distortion_coeffs: [0.1, 0.2, 0.0, 0.0]\n"
        "  distortion_model: radtan\n  intrinsics: [365.5, 366.5, 255.5, 205.0]\n"
        "  resolution: [512, 424]\n  rostopic: /cam0\n",
        "azure.json": json.dumps(_azure()),
    }
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="utf-8")
    (folder / "opencv.yaml").write_text(_OPENCV_YAML, encoding="utf-8")
    (folder / "opencv.xml").write_text(_OPENCV_XML, encoding="utf-8")
    return [folder / name for name in (*texts, "opencv.yaml", "opencv.xml")]


def _azure() -> dict[str, Any]:
    numbers = [0.5, 0.5, 0.49, 0.49, *[0.1] * 10]
    lens = {
        "ModelParameters": numbers,
        "ModelType": "CALIBRATION_LensDistortionModelBrownConrady",
    }
    camera = {"Purpose": "CALIBRATION_CameraPurposeDepth", "Intrinsics": lens}
    return {"CalibrationInformation": {"Cameras": [camera]}}


def _lens(source: Path) -> Callable[[random.Random, Path], object]:
    content = source.read_bytes()
    suffix = "" if source.name.startswith("opencv") else source.suffix

    def attempt(generator: random.Random, folder: Path) -> object:
        path = folder / source.name
        path.write_bytes(_change_text(content, generator, suffix))
        lens = read_intrinsics(path)
        matrix = np.array(lens.matrix)
        if matrix.shape != (3, 3) or not np.isfinite(matrix).all():
            raise SilentlyDifferentError(f"{path.name}: a matrix that is none was accepted")
        return lens.camera((512, 424))

    return attempt


def _bop(generator: random.Random, folder: Path) -> object:
    pose = {"cam_R_w2c": np.eye(3).ravel().tolist(), "cam_t_w2c": [1.0, 2.0, 3.0]}
    one = {"cam_K": np.ravel(_K).tolist(), "depth_scale": 0.1, **pose}
    content = json.dumps({str(n): one for n in range(3)}).encode()
    path = folder / "scene_camera.json"
    if generator.random() < 0.6:
        tree = change_tree(json.loads(content), generator)
        path.write_text(json.dumps(tree, default=str), encoding="utf-8", errors="replace")
    else:
        path.write_bytes(change_bytes(content, generator))
    return read_scene_camera(path)


def _image_files(folder: Path, generator: np.random.Generator) -> list[Path]:
    depth = generator.integers(400, 4000, (10, 12)).astype(np.uint16)
    metres = (depth / 1e3).astype(np.float32)
    for name in ("depth.png", "depth.tiff", "depth.pgm"):
        Image.fromarray(depth).save(folder / name)
    Image.fromarray(metres).save(folder / "metres.tiff")
    grey = np.dstack([(depth // 16).astype(np.uint8)] * 3)
    Image.fromarray(grey).save(folder / "grey.jpg")
    np.save(folder / "depth.npy", metres)
    names = ["depth.png", "depth.tiff", "metres.tiff", "depth.pgm", "grey.jpg", "depth.npy"]
    return [folder / name for name in names]


def _image(source: Path) -> Callable[[random.Random, Path], object]:
    content = source.read_bytes()
    read = read_grey if source.suffix == ".jpg" else read_array
    wanted = read(source)

    def attempt(generator: random.Random, folder: Path) -> object:
        path = folder / source.name
        changed = change_bytes(content, generator)
        if source.suffix == ".png" and generator.random() < 0.2:
            changed = _png_with_fitting_checksums(content, generator)
        path.write_bytes(changed)
        try:
            found = read(path)
        except RefusedViewError as error:
            raise TofcorrError(str(error)) from None
        whole = source.suffix == ".png" and not _png_is_whole(changed)
        if whole and not np.array_equal(found, wanted):
            raise SilentlyDifferentError(f"{path.name}: a damaged PNG gave other numbers")
        if source.suffix == ".npy":
            other = np.load(path, allow_pickle=False).squeeze()
            if not np.array_equal(found, other, equal_nan=found.dtype.kind == "f"):
                raise SilentlyDifferentError(f"{path.name}: other numbers than NumPy reads")
        return found

    return attempt


def _png_is_whole(content: bytes) -> bool:
    """Whether all chunks are there with checksums that fit, by PNG's own rules."""
    place, name = 8, b""
    while place + 12 <= len(content) and name != b"IEND":
        (length,) = struct.unpack(">I", content[place : place + 4])
        name, data = content[place + 4 : place + 8], content[place + 8 : place + 8 + length]
        stored = content[place + 8 + length : place + 12 + length]
        if stored != struct.pack(">I", zlib.crc32(name + data)):
            return False
        place += 12 + length
    return name == b"IEND"


def _png_with_fitting_checksums(content: bytes, generator: random.Random) -> bytes:
    """Change the header's numbers, such as width and bit depth, and correct its checksum."""
    head = bytearray(content[12:29])
    head[generator.randrange(4, 17)] = generator.randrange(256)
    return content[:12] + bytes(head) + struct.pack(">I", zlib.crc32(head)) + content[33:]


def _distances(generator: random.Random, folder: Path) -> object:
    rows = [[f"{0.5 + 0.01 * n:.3f}", *(f"{400 + 7 * n + k}" for k in range(4))] for n in range(8)]
    content = "\n".join(map(",".join, [["time", "a", "b", "c", "d"], *rows])).encode()
    path = folder / "measurements.csv"
    path.write_bytes(_change_text(content, generator, ".csv"))
    return read_distances(path, (2, 2), generator.choice((None, 1.0)))
