"""A recording of walls: what is written, and what every command then makes of it."""

from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import synthetic_scene
from cameras import apart
from importing.walls.rendered_room import Room, Views, hand_eye_anywhere, pinhole, poses_in_room
from importing.walls.rendered_room import imported as imported_room
from optional import present

import tofcorr
from tofcorr.data.recording import Recording
from tofcorr.data.writing import RecordingWriter
from tofcorr.errors import CalibrationDataError
from tofcorr.importing.posed import PosedImport
from tofcorr.pixels.dataset import Dataset

EA = {"name": "EA", "model": synthetic_scene.EA}


class Imported(NamedTuple):
    """A room with clutter, recorded and imported."""

    room: Room
    views: Views
    recording: Recording
    report: dict[str, Any]


def import_room(out: Path, images: int, clutter: float) -> Imported:
    generator = np.random.default_rng(2)
    hand_eye = hand_eye_anywhere(generator)
    room = Room(pinhole(48, 40, 46.0), tool_from_camera=hand_eye, clutter=clutter)
    views = room.views(poses_in_room(images, generator), generator)
    given = room.camera, views.world_from_tool, views.depth, views.amplitude
    return Imported(room, views, *imported_room(out, *given))


@pytest.fixture(scope="module")
def imported(tmp_path_factory: pytest.TempPathFactory) -> Imported:
    # Much clutter would be taken for a mistake, and all mistakes tried.
    return import_room(tmp_path_factory.mktemp("room") / "walls", 40, 0.02)


def test_planes_off_all_walls_that_no_mistake_explains_are_warned_of(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    undone = [("the columns mirrored", 300.0, 1.0)]
    monkeypatch.setattr(PosedImport, "_mistakes_undone", lambda *_: iter(undone))
    (warning,) = import_room(tmp_path / "walls", 16, 0.2).report["warnings"]
    assert "images show a wall, and planes are off by" in warning


def test_each_image_and_wall_is_a_frame_with_a_mask_of_its_own(imported: Imported) -> None:
    recording, views, table = imported.recording, imported.views, imported.recording.frames
    of_image = np.array([int(view["view"]) for view in imported.report["views"]])
    assert recording.num_frames == len(of_image) > len(views.depth)
    walls = {wall["name"]: wall for wall in imported.report["walls"]}
    masks = np.asarray(present(recording.mask), dtype=int)
    for frame, image in enumerate(of_image):
        wall = walls[str(table.target[frame])]
        np.testing.assert_allclose(table.normal_world[frame], wall["normal_world"], atol=1e-12)
        assert table.timestamp[frame] == image
        pose = views.world_from_tool[image]
        np.testing.assert_allclose(table.world_from_tool[frame], pose, atol=1e-12)
        np.testing.assert_allclose(recording.depth[frame], views.depth[image], rtol=1e-6)
        true = views.plane[image][masks[frame] == 1]
        assert np.bincount(true + 1).max() > 0.9 * len(true)
    for image in set(of_image):
        own = of_image == image
        assert len(set(present(table.pose_id)[own])) == 1
        assert masks[own].sum(axis=0).max() == 1
    assert len(np.unique(Dataset((recording,)).pose_groups())) == len(set(of_image))


def test_header_and_report_say_what_was_found_and_what_was_not(imported: Imported) -> None:
    recording, report = imported.recording, imported.report
    assert recording.planes == "estimated"
    np.testing.assert_allclose(recording.tool_from_camera, report["tool_from_camera"])
    assert {wall["name"] for wall in report["walls"]} >= {"wall 1", "floor"}
    assert all(one["view"] and one["reason"] for one in report["refused"])


def test_training_finds_the_hand_eye_without_being_told_anything(imported: Imported) -> None:
    split = {"test_fraction": 0.2, "seed": 0}
    options = EA | {"advice": 0, "weights": {"robust": "cauchy"}, "split": split}
    result = tofcorr.train(imported.recording, options)
    report = result.report
    off = apart(report["hand_eye"]["tool_from_camera"], imported.room.tool_from_camera)
    assert (off < (1.0, 0.1)).all()
    # Noise of 3 mm along the ray is less towards the plane.
    assert report["error_mm"]["after"]["test"]["rms"] < 3.0
    assert {wall["wall"] for wall in report["walls"]} == set(imported.recording.frames.target)


def test_every_column_is_judged_against_its_own_walls(imported: Imported, tmp_path: Path) -> None:
    bent = _with_planes_of_nonsense(imported.recording, tmp_path / "bent")
    options = {"models": [EA], "folds": 0}
    sets = (tofcorr.evaluate(one, options).sets[0] for one in (imported.recording, bent))
    first, second = (one.values["half"]["rms_mm"] for one in sets)
    assert max(first[column][0] for column in ("before", "hand-eye only")) < 40.0
    assert first["EA"][0] < 3.0
    # Planes 20 degrees and 200 mm off are a start and no more.
    for column in ("before", "EA"):
        assert second[column][0] == pytest.approx(first[column][0], abs=0.05)


def test_a_wall_of_no_training_image_is_estimated_alone_and_not_believed(
    imported: Imported, tmp_path: Path
) -> None:
    bent = _with_planes_of_nonsense(imported.recording, tmp_path / "bent", only="wall 2")
    options = {"models": [EA], "by": ["target"]}
    decisive = tofcorr.select(bent, options).decisive
    assert decisive.errors["EA"].mean < 6.0


@pytest.mark.slow
def test_checking_uses_no_estimated_plane(imported: Imported, tmp_path: Path) -> None:
    tofcorr.train(imported.recording, EA | {"advice": 0}, out=tmp_path / "run")
    with pytest.raises(CalibrationDataError, match="planes are estimated from the depth"):
        tofcorr.check(tmp_path / "run", imported.recording, wall="recorded")
    with pytest.raises(CalibrationDataError, match="the frames show 4 "):
        tofcorr.check(tmp_path / "run", imported.recording, wall="one")
    bent = _with_planes_of_nonsense(imported.recording, tmp_path / "bent")
    first, second = (tofcorr.check(tmp_path / "run", one) for one in (imported.recording, bent))
    assert first.to_mapping() == second.to_mapping()


def test_an_outlier_window_around_estimated_planes_is_refused(imported: Imported) -> None:
    with pytest.raises(CalibrationDataError, match="outlier_window_mm compares with the recorded"):
        tofcorr.train(imported.recording, EA | {"outlier_window_mm": 100.0})


@pytest.mark.parametrize(
    ("planes", "walls"),
    [
        ("known", None),
        *(pytest.param(name, 4, marks=pytest.mark.slow) for name in ("auto", "unknown")),
    ],
)
def test_known_and_unknown_still_say_what_the_header_does_not(
    imported: Imported, planes: str, walls: int | None
) -> None:
    # Which planes are believed does not depend on the model: one term is enough.
    one_term = {"model": {"terms": [{"kind": "distance_polynomial", "degree": 1}]}, "advice": 0}
    report = tofcorr.train(imported.recording, EA | one_term | {"planes": planes}).report
    assert (None if report["walls"] is None else len(report["walls"])) == walls


def _with_planes_of_nonsense(recording: Recording, out: Path, only: str | None = None) -> Recording:
    """Copy a recording, its planes turned by 20 degrees and moved by 200 mm, each another way."""
    turns = {name: k for k, name in enumerate(np.unique(recording.frames.target))}
    with RecordingWriter.like(out, recording, rows=False) as writer:
        for k in range(recording.num_frames):
            row = recording.frames.row(k)
            if only in (None, row.target):
                normal = row.normal_world + np.roll([0.36, -0.18, 0.1], turns[row.target])
                normal /= np.linalg.norm(normal)
                row = replace(row, normal_world=normal, offset=row.offset + 0.2)
            amplitude, mask = (np.asarray(one)[k] for one in (recording.amplitude, recording.mask))
            writer.append(recording.depth[k], row=row, amplitude=amplitude, mask=mask)
    return Recording.open(out)
