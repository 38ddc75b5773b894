"""No cause is named that is not there: units, turned zones, amplitudes, and lengths."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from plausibility.test_faults import without_robot
from simulated_walls import QUIET, simulated_wall, true_hand_eye

import tofcorr
from benchmarks.wrong_recordings.parts import Parts
from tofcorr.plausibility import mistakes
from tofcorr.plausibility.alignment import Alignment
from tofcorr.plausibility.examine import inspect

ZONES = {"width": 8, "height": 8, "K": [[9.7, 0.0, 3.5], [0.0, 9.7, 3.5], [0.0, 0.0, 1.0]]}
Change = Callable[[np.ndarray], np.ndarray]


@pytest.fixture(scope="module")
def zones(tmp_path_factory: pytest.TempPathFactory) -> Parts:
    """A sensor of 8 x 8 zones on a tripod, before boards whose planes are known."""
    folder = tmp_path_factory.mktemp("zones") / "wall"
    data = simulated_wall(folder, 3, (("white", 12),), QUIET, camera=ZONES | {"distortion": []})
    return without_robot(Parts.read(folder), true_hand_eye(data).numpy())


@pytest.mark.parametrize(
    ("change", "cause"),
    [
        (lambda depth: depth, None),
        (lambda depth: np.rot90(depth, 1, (1, 2)), "undone: the images are turned to the right;"),
        (lambda depth: np.rot90(depth, 2, (1, 2)), "undone: the images are turned by half a turn;"),
        (lambda depth: np.rot90(depth, 3, (1, 2)), "undone: the images are turned to the left;"),
        (lambda depth: np.rot90(depth, 2, (1, 2)).mT, "undone: the images are mirrored along a d"),
        (lambda depth: depth / 0.3048, "undone: the depth is in feet;"),
        # A sensor 0.3 m from a wall, in millimetres, was said to give centimetres.
        (lambda depth: 300 * depth / np.median(depth), "to be in millimetres or centimetres"),
    ],
)
def test_zones_that_are_turned_are_told_from_units_and_planes(
    zones: Parts, tmp_path: Path, change: Change, cause: str | None
) -> None:
    # The planes were said not to be in the camera's frame, or the depth to be in feet.
    images = {"depth": change(zones.depth), "amplitude": None}
    found = inspect(zones.changed(**images).write(tmp_path / "turned"))
    assert (cause is None) == (not found.impossible)
    assert cause is None or cause in found.impossible[0].sentence


def test_a_unit_that_makes_all_misfits_small_explains_none(
    clean: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Correct millimetres were refused as feet, in which every misfit is a third.
    look = inspect(clean).look

    def aligned(misfit: float, distance: float) -> Alignment:
        each = np.full(len(look.frames), misfit)
        return Alignment(np.eye(4), 0.0, 0.0, each, 0 * each, distance)

    look.as_given = aligned(0.05, 1.0)
    for left, named in ((0.05, False), (0.01, True)):
        found = [("the depth is in feet", "write metres", aligned(0.3048 * left, 0.3048), False)]
        monkeypatch.setattr(mistakes, "explanations", lambda _, one=found: one)
        assert bool(mistakes.best_explanations(look)) == named


@pytest.mark.parametrize(("factor", "first"), [(1e3, 21), (1e-3, 15)])
def test_amplitudes_in_two_units_are_named(
    parts: Parts, tmp_path: Path, factor: float, first: int
) -> None:
    # The run was `good`, or its export was said to differ from the float64 model by 3e-6 m.
    scale = np.where(np.arange(len(parts.depth)) >= first, factor, 1.0)[:, None, None]
    assert parts.amplitude is not None
    found = inspect(parts.changed(amplitude=parts.amplitude * scale).write(tmp_path / "units"))
    assert "amplitudes in two units" in str(found.headline)
    assert found.findings[0].frames[0] == first


def test_dark_squares_that_fill_the_view_are_no_other_exposure(tmp_path: Path) -> None:
    # Near a board, seven frames were said to see it "6.2 times as bright", by another exposure.
    near = {"distance_m": [0.15, 0.4], "farthest_pixel_m": 0.8, "tilt_deg": 30.0}
    data = simulated_wall(tmp_path / "near", 1029, (("checkerboard", 24),), QUIET, robot=near)
    assert not [one for one in inspect(data.first.path).findings if one.check == "exposure"]


@pytest.mark.parametrize(
    ("light", "longer", "check"),
    [(0.02, 1.0, "room"), (0.0, 1.05, "focal length"), (0.0, 1.0, None)],
)
def test_light_of_a_room_is_told_from_a_focal_length(
    tmp_path: Path, light: float, longer: float, check: str | None
) -> None:
    # Both bend tilted walls; light of a room was headed "the focal length were 6 % shorter".
    lit = [{"name": "multipath", "room_x0_y0": light}]
    shots = (("white", 16), ("checkerboard", 24))
    simulated_wall(tmp_path / "wall", 41, shots, QUIET, effects=lit)
    parts = Parts.read(tmp_path / "wall")
    matrix = np.diag([longer, longer, 1.0]) @ np.array(parts.header["camera"].matrix)
    matrix[:2, 2] /= longer
    camera = replace(parts.header["camera"], matrix=tuple(map(tuple, matrix.tolist())))
    found = inspect(parts.changed(camera=camera).write(tmp_path / "changed")).findings
    assert [one.check for one in found if one.severity == "doubtful"] == ([check] if check else [])


@pytest.mark.parametrize(("robot", "camera"), [(1.03, 1.0), (1.0, 1 / 1.03), (1 / 1.05, 1.0)])
def test_robot_and_camera_of_another_scale_are_headed_alike(
    parts: Parts, tmp_path: Path, robot: float, camera: float
) -> None:
    # A robot 3 % too long was `good`, a camera 3 % off `Ambiguous`: no recording tells them apart.
    scaled = parts.changed(place=robot * parts.place, depth=camera * parts.depth)
    found = inspect(scaled.write(tmp_path / "scaled"))
    assert [one.check for one in found.findings if one.severity == "ambiguous"] == ["scale"]
    assert "those of the robot, which count as true" in str(found.headline)


def test_without_a_robot_nothing_is_said_of_one(parts: Parts, clean: Path, tmp_path: Path) -> None:
    # Verdicts spoke of the hand-eye transform of a camera on a tripod.
    hand_eye = inspect(clean).look.given.hand_eye
    still = without_robot(parts, hand_eye)
    wrong = still.changed(
        offset=np.where(np.arange(len(still.offset)) % 2, 1.05, 1.0) * still.offset
    )
    report = tofcorr.train(wrong.write(tmp_path / "board"), "ea", force=True).report
    words = f"{report['reason']} {report['expected']} {report['headline']}"
    assert not any(word in words for word in ("hand-eye", "robot", "poses"))
