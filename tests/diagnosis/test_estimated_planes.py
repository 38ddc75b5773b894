"""Planes found in the depth are fitted beside every effect; what they absorb is not judged."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from diagnosed_recordings import recorded
from importing.walls.rendered_room import Room, hand_eye_anywhere, imported, pinhole, poses_in_room
from optional import present

from tofcorr.data.recording import Recording
from tofcorr.data.table import FrameRow
from tofcorr.data.writing import RecordingWriter, write_recording
from tofcorr.diagnosis.diagnose import Prepared, diagnose, prepare
from tofcorr.diagnosis.findings.naming import name_effects
from tofcorr.diagnosis.options import DiagnosisOptions
from tofcorr.diagnosis.sums.observations import (
    observe,
    predicted_distance,
    wall_columns,
    with_numbered_walls,
    with_walls_moved,
)
from tofcorr.diagnosis.sums.study import Study
from tofcorr.errors import CalibrationDataError
from tofcorr.importing.robot_images import PosedOptions

QUICK = DiagnosisOptions(bootstraps=20, simulate_anew=False, page=False)
EFFECTS: dict[str, dict[str, Any]] = {
    "wiggling": {"sin_4": 0.012, "cos_8": 0.006},
    "integration_time": {"log_1": 0.006},
    "room_temperature": {"per_degree": 0.004},
    "ambient_light": {"linear": 0.012, "reference_counts": 800.0},
    "robot_kinematics": {"scale_zx": 0.012, "scale_zy": -0.01},
    "row_column_pattern": {"row_rms_m": 0.004, "column_rms_m": 0.004, "height": 24, "width": 32},
}


def with_walls_found(recording: Recording) -> Recording:
    """Return the recording as an importer leaves it, its plane found in the depth."""
    out, table = recording.path.with_name(f"{recording.path.name}_walls"), recording.frames
    same = {name: getattr(recording, name) for name in ("depth_kind", "saturation_amplitude")}
    images = (recording.camera, table.world_from_tool, recording.depth, recording.amplitude)
    found, report = imported(out.with_suffix(".plain"), *images, options=PosedOptions(**same))
    image = np.array([int(view["view"]) for view in report["views"]])
    ids = image if table.pose_id is None else table.pose_id[image]
    # An importer knows no conditions of a frame: they are those of its image.
    known = replace(found, modulation_frequency=recording.modulation_frequency)
    with RecordingWriter.like(out, known, rows=False) as writer:
        for frame, number in enumerate(image):
            plane = found.frames.row(frame)
            seen = {"offset": plane.offset, "target": plane.target, "pose_id": str(ids[frame])}
            row = replace(table.row(number), normal_world=plane.normal_world, **seen)
            parts = {
                name: array[number]
                for name in ("depth", "amplitude", "raw")
                if (array := getattr(recording, name)) is not None
            }
            writer.append(row=row, mask=np.asarray(found.mask)[frame], **parts)
    return Recording.open(out)


@pytest.fixture(scope="module")
def walls(time_missing: Recording) -> Recording:
    return with_walls_found(time_missing)


@pytest.fixture(scope="module")
def prepared(walls: Recording) -> Prepared:
    return prepare(walls, QUICK)


def two_walls(recording: Recording) -> Recording:
    """Return the recording with every second frame's plane 20 mm off and named another wall."""
    table = recording.frames
    second = np.arange(len(table)) % 2 == 1
    target = np.where(second, "other", "one")
    offset = table.offset + 0.02 * second
    return replace(recording, frames=replace(table, target=target, offset=offset))


def test_columns_are_the_differences_of_the_predicted_distance(walls: Recording) -> None:
    observations = with_numbered_walls(observe(two_walls(walls), 4000))
    pose = torch.from_numpy(walls.tool_from_camera)
    columns = wall_columns(observations, pose)
    assert columns.shape == (len(observations.measured), 6)
    for number in range(6):
        step = torch.zeros(6, dtype=torch.float64)
        step[number] = 1e-5
        moved = (with_walls_moved(observations, sign * step) for sign in (1, -1))
        ahead, behind = (predicted_distance(one, pose) for one in moved)
        slope = (ahead - behind) / 2e-5
        torch.testing.assert_close(columns[:, number], slope, rtol=1e-6, atol=1e-6)


def test_the_same_effect_is_named_first_as_with_measured_planes(
    prepared: Prepared, time_study: Study
) -> None:
    """Walls that are found hold pixels of their edges; what these add is less probable."""
    estimated, measured = name_effects(prepared.study), name_effects(time_study)
    assert measured.names == ("integration_time",)
    assert estimated.names[0] == "integration_time"
    assert estimated.cause_sets[0] == measured.cause_sets[0]
    assert all(estimated.probabilities[name] < 0.7 for name in estimated.names[1:])


def test_what_planes_absorb_needs_measured_planes_by_name(prepared: Prepared) -> None:
    for name in ("target_registration", "incidence_angle"):
        assert prepared.study.missing[name] == ["measured planes"]
        assert name not in prepared.study.effects
        assert name not in prepared.study.sums.layout.effects
    (warning,) = prepared.warnings
    assert "plane of 1 wall is estimated together with the base model" in warning
    assert "measured planes are needed: target_registration, incidence_angle" in warning


def test_planes_are_a_start_and_never_believed(walls: Recording) -> None:
    alone = DiagnosisOptions(catalogue=("integration_time",))
    found = prepare(walls, alone).study
    table = walls.frames
    normal = table.normal_world + np.array([0.02, -0.03, 0.01])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    bent = replace(walls, frames=replace(table, normal_world=normal, offset=table.offset + 0.04))
    study = prepare(bent, alone).study
    for one, other, within in (
        (study.fit.residual, found.fit.residual, 5e-5),
        (study.fit.tool_from_camera, found.fit.tool_from_camera, 1e-3),
        (study.observations.facts.offset, found.observations.facts.offset, 1e-3),
    ):
        assert float((one - other).abs().max()) < within
    assert study.observations.recording.frames.offset[0] == study.observations.facts.offset[0]


def test_a_wall_of_two_poses_and_a_standing_camera_are_refused(walls: Recording) -> None:
    table = walls.frames
    few = replace(table, target=np.where(np.arange(len(table)) < 2, "corner", "wall"))
    with pytest.raises(CalibrationDataError, match="'corner' is seen from 2 poses; 3 are needed"):
        prepare(replace(walls, frames=few), QUICK)
    still = np.tile(np.eye(4), (len(table), 1, 1))
    fixed = replace(walls, frames=replace(table, world_from_tool=still))
    with pytest.raises(CalibrationDataError, match="no robot moves"):
        prepare(fixed, QUICK)


@pytest.mark.slow
def test_the_simulator_rerun_on_the_walls_found_closes_the_gap(walls: Recording) -> None:
    result = diagnose(walls, config=DiagnosisOptions(bootstraps=40))
    closure = present(result.closure)
    assert closure.without_effects > 2e-3
    assert closure.with_effects < 0.6e-3
    assert "target_registration" in result.evidence.study.missing


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(EFFECTS))
def test_each_effect_is_in_the_one_set_as_with_measured_planes(name: str, tmp_path: Path) -> None:
    measured = recorded(tmp_path / name, 830, [{"name": name, **EFFECTS[name]}])
    estimated = with_walls_found(measured)
    named = [name_effects(prepare(one, QUICK).study) for one in (measured, estimated)]
    assert [len(one.names) for one in named] == [1, 1]
    assert all(name in one.cause_sets[0] for one in named)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["target_registration", "incidence_angle"])
def test_nothing_is_named_in_place_of_what_planes_absorb(name: str, tmp_path: Path) -> None:
    size = {"secant": 0.06} if name == "incidence_angle" else {"offset_m": 0.01, "lean_x": 0.006}
    recording = recorded(tmp_path / name, 831, [{"name": name, **size}])
    named = name_effects(prepare(with_walls_found(recording), QUICK).study)
    assert named.names == ()


def room_recording(
    folder: Path, seed: int, wiggling: float = 0.0, per_log_time: float = 0.0
) -> Recording:
    """Render three walls and a floor, add errors by hand, and find the walls."""
    generator = np.random.default_rng(seed)
    room = Room(pinhole(48, 40, 46.0), tool_from_camera=hand_eye_anywhere(generator))
    views = room.views(poses_in_room(40, generator), generator)
    time = generator.choice([250.0, 500.0, 1000.0], len(views.depth))
    # The fourth harmonic of the phase of light modulated at 20 MHz.
    phase = 4 * np.pi * 20e6 / 299_792_458.0 * views.depth
    depth = views.depth + wiggling * np.sin(4 * phase)
    depth = depth + per_log_time * np.log(time / 500.0)[:, None, None]
    rows = [
        FrameRow(
            timestamp=20.0 * k,
            world_from_tool=pose,
            normal_world=np.array([0.0, 0.0, -1.0]),
            offset=1.0,
            target="unknown",
            integration_time=float(time[k]),
        )
        for k, pose in enumerate(views.world_from_tool)
    ]
    write_recording(
        folder / "source",
        camera=room.camera,
        depth_kind="radial",
        modulation_frequency=20e6,
        rows=rows,
        depth=depth,
        amplitude=views.amplitude,
    )
    return with_walls_found(Recording.open(folder / "source"))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "sizes"),
    [("wiggling", {"wiggling": 0.012}), ("integration_time", {"per_log_time": 0.006})],
)
def test_an_error_added_by_hand_before_four_walls_is_named(
    name: str, sizes: dict[str, float], tmp_path: Path
) -> None:
    recording = room_recording(tmp_path, 850, **sizes)
    study = prepare(recording, QUICK).study
    assert study.observations.num_walls == 4
    named = name_effects(study)
    assert named.names[:1] == (name,)


@pytest.mark.slow
@pytest.mark.parametrize(("walls", "first"), [(1, 840), (4, 860)])
def test_nothing_is_named_where_nothing_is_missing(walls: int, first: int, tmp_path: Path) -> None:
    named = []
    for seed in range(first, first + 10):
        folder = tmp_path / str(seed)
        if walls == 1:
            recording = with_walls_found(recorded(folder, seed))
        else:
            recording = room_recording(folder, seed)
        named += name_effects(prepare(recording, QUICK).study).names
    # A test at 5 % names something on more than two of ten recordings with probability 1.2 %.
    assert len(named) <= 2
