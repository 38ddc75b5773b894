"""A room from a file of triangles is that of its faces."""

import math
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from scene_light.test_bounces import HERE, ROOM, bounces, frames_of_walls, in_room, room
from torch import Generator

from tofcorr.errors import ConfigError
from tofcorr.geometry import se3
from tofcorr.options import resolve_options
from tofcorr.scene_light.bounces import SecondBouncesOptions
from tofcorr.scene_light.gain import fit_gain
from tofcorr.scene_light.room import Face, MeshFile


def area(faces: tuple[Face, ...]) -> float:
    corners = [np.array(face.corners) for face in faces]
    sides = [np.cross(x, np.roll(x, -1, 0)).sum(0) for x in corners]
    return float(sum(np.linalg.norm(side) for side in sides)) / 2


FORMS = [("ply", "ascii"), ("ply", "binary"), ("obj", ""), ("stl", ""), ("stl_ascii", "")]


@pytest.mark.parametrize(("form", "encoding"), FORMS)
def test_a_mesh_in_millimetres_is_the_room_of_its_faces(
    form: str, encoding: str, tmp_path: Path
) -> None:
    rectangles = [np.array(face["corners"]) * 1e3 for face in ROOM]
    halves = [trimesh.Trimesh(x, [[0, 1, 2], [0, 2, 3]]).subdivide() for x in rectangles]
    file = tmp_path / f"room.{form[:3]}"
    options = {"encoding": encoding} if encoding else {}
    trimesh.util.concatenate(halves).export(str(file), file_type=form, **options)
    found = room(room={"file": str(file), "scale": 1e-3})
    assert len(found.room.corners) == 2
    expected, distance = room(), in_room(room())
    for own in (found, expected):
        own.room.set_pose(torch.eye(4))
    torch.testing.assert_close(
        found.removed(*distance), expected.removed(*distance), rtol=0, atol=1e-4
    )


def test_what_is_bent_or_not_convex_keeps_its_area(tmp_path: Path) -> None:
    corners = [[0, 0, 0], [2, 0, 0], [2, 1, 0], [1, 1, 0], [1, 2, 0], [0, 2, 0]]
    ell = trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5]])
    ell.export(str(tmp_path / "ell.ply"))
    tube = trimesh.creation.cylinder(0.2, 1.0, sections=600)
    tube.export(str(tmp_path / "tube.ply"))
    found = [MeshFile(file=str(tmp_path / f"{n}.ply"), most_faces=9999) for n in ("ell", "tube")]
    assert area(found[0].faces()) == pytest.approx(3.0)
    assert area(found[1].faces()) == pytest.approx(2 * math.pi * (0.2 + 0.04), rel=0.01)


def test_of_too_many_faces_the_largest_are_kept(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    box = trimesh.creation.box((1.0, 2.0, 3.0)).subdivide()
    box.export(str(tmp_path / "box.stl"))
    named = {"file": str(tmp_path / "box.stl"), "most_faces": 4}
    found = resolve_options(SecondBouncesOptions, {"room": named})
    assert area(found.room) == pytest.approx(2 * (6 + 3), rel=1e-6)
    assert "the 4 largest of 6 flat faces are used, without 18.2 % of the area" in caplog.text
    # What is saved names no file.
    assert SecondBouncesOptions.model_validate(found.to_mapping()) == found


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("none.ply", None, r"none\.ply: no readable PLY, OBJ or STL file \(No such file"),
        ("broken.ply", "hello", r"no readable PLY, OBJ or STL file \(Not a ply file"),
        ("room.step", "hello", "no readable PLY, OBJ or STL file"),
        (
            "points.obj",
            "v 0 0 0\nv 1 0 0\nv 1 1 0\n",
            "got no triangles, or corners that are no numbers",
        ),
        (
            "nan.obj",
            "v 0 0 0\nv nan 0 0\nv 1 1 0\nf 1 2 3\n",
            "got no triangles, or corners that are no numbers",
        ),
        (
            "mm.obj",
            "v 0 0 0\nv 3000 0 0\nv 0 9 0\nf 1 2 3\n",
            r"0\.1 to 300 m, got 3e\+03 m; set `scale`",
        ),
    ],
)
def test_a_file_that_is_no_room_is_refused(
    name: str, content: str | None, said: str, tmp_path: Path
) -> None:
    if content is not None:
        (tmp_path / name).write_text(content)
    with pytest.raises(ConfigError, match=rf"'room': .*{said}"):
        resolve_options(SecondBouncesOptions, {"room": str(tmp_path / name)})


def test_keys_and_the_missing_package_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ConfigError, match=r"'scael' is not a known key\. Did you mean 'scale'"):
        resolve_options(SecondBouncesOptions, {"room": {"file": "x.ply", "scael": 1}})
    monkeypatch.setitem(sys.modules, "trimesh", None)
    with pytest.raises(ConfigError, match=r"x\.ply needs trimesh: pip install 'tofcorr\[mesh\]'"):
        resolve_options(SecondBouncesOptions, {"room": "x.ply"})


def test_a_gain_is_fitted_in_a_room_of_the_world_by_the_poses(generator: Generator) -> None:
    pose = se3.exp(torch.tensor([0.3, -0.2, 0.5, 0.1, 0.4, -0.2]).double())
    beyond = {"room_in_image": False, "gain": 0.9 / 500}
    corners = [torch.tensor(face["corners"]).double() for face in ROOM]
    turned = [{"corners": (x @ pose[:3, :3].T + pose[:3, 3]).tolist()} for x in corners]
    frames, base = frames_of_walls(generator), lambda distance, _: distance[None]
    still = fit_gain(room(**beyond, room_axes="camera"), frames, base, HERE)
    poses = pose.expand(len(frames), 4, 4)
    moved = fit_gain(room(**beyond, room=turned), frames, base, poses)
    assert moved.gain == pytest.approx(still.gain, rel=1e-6)
    without = fit_gain(bounces(**beyond, continued=False), frames, base, HERE)
    assert abs(still.gain - without.gain) > 1e-3 * still.gain
