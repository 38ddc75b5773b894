"""Laws of the second generator: independent, repeatable, right in size, valid recordings."""

import ast
import hashlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.withheld import cases
from benchmarks.withheld.generator.catalogue import INSIDE, NEEDS_MOTION, OUTSIDE, draw_effect
from benchmarks.withheld.generator.effect import Applied
from benchmarks.withheld.generator.noise import NOISES
from benchmarks.withheld.generator.observe import demodulate, look, taps_of
from benchmarks.withheld.generator.poses import Design
from benchmarks.withheld.generator.recording import record, record_again
from benchmarks.withheld.generator.strength import error_field, scale_to
from benchmarks.withheld.generator.tiers import TIERS, draw_case
from benchmarks.withheld.generator.world import World, draw_setup, draw_world
from benchmarks.withheld.generator.writing import write_recording

GENERATOR = Path(cases.__file__).parent / "generator"
EFFECTS = [*INSIDE, *OUTSIDE]


def a_world(seed: int = 0, **design: Any) -> World:
    rng = np.random.default_rng(seed)
    design.setdefault("frames", 24)
    return draw_world(rng, draw_setup(rng), Design(**design))


def tree_hash(folder: Path) -> str:
    digest = hashlib.sha256()
    for file in sorted(folder.rglob("*")):
        if file.is_file():
            digest.update(str(file.relative_to(folder)).encode() + file.read_bytes())
    return digest.hexdigest()


def imported(file: Path) -> set[str]:
    names = set()
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            names.add(node.module or "")
    return names


def test_generator_imports_numpy_itself_and_the_standard_library_only() -> None:
    allowed = {"numpy", "dataclasses", "collections", "typing", "functools", "json", "pathlib"}
    for file in GENERATOR.glob("*.py"):
        foreign = {
            name
            for name in imported(file)
            if name.split(".")[0] not in allowed
            and not name.startswith("benchmarks.withheld.generator")
        }
        assert not foreign, f"{file.name} imports {foreign}"


def test_nothing_of_the_benchmark_imports_the_program_but_the_worker_that_runs_it() -> None:
    importing = {
        file.name
        for file in GENERATOR.parent.rglob("*.py")
        if any(name.split(".")[0] == "tofcorr" for name in imported(file))
    }
    assert importing == {"worker.py"}


@pytest.mark.parametrize("name", EFFECTS)
def test_error_of_an_effect_has_the_size_asked_for(name: str) -> None:
    world = a_world(moving=name in NEEDS_MOTION)
    view = look(world)
    effect = draw_effect(name, np.random.default_rng(1))
    applied, field = scale_to(view, effect, 3e-3)
    assert np.sqrt(np.mean(field[view.used] ** 2)) == pytest.approx(3e-3, rel=5e-3)
    full = world.camera.unambiguous_range
    changed = look(world, [applied])
    measured = demodulate(taps_of(changed, [applied]), full)[0] - demodulate(taps_of(view), full)[0]
    both = view.used & changed.used
    assert np.sqrt(np.mean(measured[both] ** 2)) == pytest.approx(3e-3, rel=0.08)


@pytest.mark.parametrize("name", EFFECTS)
def test_an_effect_of_no_strength_changes_nothing(name: str) -> None:
    world = a_world(moving=name in NEEDS_MOTION, frames=12)
    view = look(world)
    effect = draw_effect(name, np.random.default_rng(1))
    nothing = 1e-12 if name != "saturation" else 1e-3
    assert np.abs(error_field(view, Applied(effect, nothing))[view.used]).max() < 1e-8


def test_without_effects_the_four_samples_tell_the_path() -> None:
    view = look(a_world())
    distance, amplitude = demodulate(taps_of(view), view.world.camera.unambiguous_range)
    np.testing.assert_allclose(distance, view.path, atol=1e-12)
    np.testing.assert_allclose(amplitude, view.amplitude, rtol=1e-12)


def test_stated_plane_and_poses_explain_the_distance_up_to_robot_noise() -> None:
    world = a_world()
    view = look(world)
    recorded, _ = record(np.random.default_rng(0), world, [], NOISES["usual"])
    camera = recorded.stated_poses @ world.setup.tool_from_camera
    rays = np.einsum("nij,hwj->nhwi", camera[:, :3, :3], world.camera.rays())
    points = camera[:, None, None, :3, 3] + view.distance[..., None] * rays
    normal, point = world.setup.world_from_target[:3, 2], world.setup.world_from_target[:3, 3]
    off = ((points - point) @ normal)[view.used]
    assert np.abs(off).max() < 6e-3
    assert np.sqrt(np.mean(off**2)) < 1e-3


@pytest.mark.parametrize(
    "tier",
    [tier if tier in "ABC" else pytest.param(tier, marks=pytest.mark.slow) for tier in TIERS],
)
def test_recordings_of_every_tier_are_valid(tier: str, tmp_path: Path) -> None:
    recording = pytest.importorskip("tofcorr.data.recording")
    for index in range(2):
        for entry in cases.write_case(5, tier, index, tmp_path):
            opened = recording.Recording.open(tmp_path / "recordings" / entry["id"])
            assert opened.moves
            used = np.asarray(opened.mask) > 0
            assert np.isfinite(np.asarray(opened.depth)[used]).mean() > 0.8


def test_same_seed_gives_the_same_bytes_whatever_else_is_drawn(tmp_path: Path) -> None:
    list(cases.generate(7, {"A": 1, "F": 1}, tmp_path / "one"))
    list(cases.generate(7, {"F": 1, "A": 1}, tmp_path / "other"))
    for part in ("recordings", "answers"):
        assert tree_hash(tmp_path / "one" / part) == tree_hash(tmp_path / "other" / part)


def test_another_seed_gives_other_recordings(tmp_path: Path) -> None:
    list(cases.generate(7, {"C": 1}, tmp_path / "one"))
    list(cases.generate(8, {"C": 1}, tmp_path / "other"))
    one, other = (
        {file.name for file in (tmp_path / seed / "recordings").iterdir()}
        for seed in ("one", "other")
    )
    assert not one & other


def test_manifest_and_recordings_do_not_tell_tier_or_effect(tmp_path: Path) -> None:
    list(cases.generate(7, {"A": 2, "C": 1}, tmp_path))
    folders = "".join(file.name for file in (tmp_path / "recordings").iterdir())
    told = (tmp_path / "manifest.json").read_text() + folders
    assert not any(name in told for name in EFFECTS)
    assert '"tier"' not in told


def test_withheld_columns_are_not_written(tmp_path: Path) -> None:
    recorded, _ = record(np.random.default_rng(0), a_world(), [], NOISES["usual"])
    withhold = frozenset({"integration_time_us", "amplitude.npy", "modulation_frequency_hz"})
    write_recording(tmp_path / "r", recorded, withhold)
    assert "integration_time_us" not in (tmp_path / "r" / "frames.csv").read_text()
    assert not (tmp_path / "r" / "amplitude.npy").exists()
    assert "modulation_frequency_hz: null" in (tmp_path / "r" / "recording.yaml").read_text()


def test_withholding_an_unknown_column_names_the_known_ones(tmp_path: Path) -> None:
    recorded, _ = record(np.random.default_rng(0), a_world(), [], NOISES["usual"])
    with pytest.raises(ValueError, match=r"cannot withhold \['tau'\].*integration_time_us"):
        write_recording(tmp_path / "r", recorded, frozenset({"tau"}))


def test_repeated_frames_have_one_pose_and_one_setting() -> None:
    world = a_world(frames=30, repeats=3)
    recorded, _ = record(np.random.default_rng(0), world, [], NOISES["usual"])
    ids, counts = np.unique(world.trajectory.pose_id, return_counts=True)
    assert sorted(counts)[-3:] == [3, 3, 3]
    for one in ids[counts == 3]:
        same = world.trajectory.pose_id == one
        assert np.ptp(recorded.stated_poses[same], axis=0).max() == 0
        assert np.ptp(world.conditions.exposure[same]) == 0


def test_recorded_again_the_effect_is_as_strong_but_the_session_another() -> None:
    rng = np.random.default_rng(2)
    setup = draw_setup(rng)
    first = draw_world(rng, setup, Design(frames=30))
    _, truth = record(rng, first, [(draw_effect("lens", rng), 4e-3)], NOISES["usual"])
    again = draw_world(rng, setup, Design(frames=60))
    _, fresh = record_again(rng, again, truth.applied, NOISES["usual"])
    assert fresh.applied == truth.applied
    assert fresh.sizes_mm["lens"] == pytest.approx(4.0, rel=0.5)
    assert fresh.sizes_mm["lens"] != truth.sizes_mm["lens"]


def test_sorted_design_moves_away_and_untilted_design_looks_straight() -> None:
    away = look(a_world(order="sorted")).world.trajectory.camera_at(np.zeros(24))
    assert (np.diff(np.linalg.norm(away[:, :3, 3], axis=1)) > -0.2).all()
    straight = a_world(tilt=False).trajectory.camera_at(np.zeros(24))
    np.testing.assert_allclose(straight[:, :3, 2], np.tile([0.0, 0.0, -1.0], (24, 1)), atol=1e-12)


def test_tier_a_takes_every_effect_once_a_round() -> None:
    rng = np.random.default_rng(0)
    names = [draw_case("A", index, rng).effects[0][0] for index in range(len(INSIDE))]
    assert sorted(names) == sorted(INSIDE)


def test_an_unknown_tier_names_the_known_ones() -> None:
    with pytest.raises(ValueError, match="no tier 'Z': expected some of A, B"):
        draw_case("Z", 0, np.random.default_rng(0))


def test_heavy_tailed_noise_has_the_variance_of_the_usual_kind() -> None:
    world = a_world()
    spread = {}
    for kind in ("usual", "tails"):
        recorded, truth = record(np.random.default_rng(0), world, [], NOISES[kind])
        used = recorded.mask & np.isfinite(recorded.depth)
        error = (recorded.depth - truth.expected)[used]
        spread[kind] = np.quantile(np.abs(error), 0.5) / np.quantile(np.abs(error), 0.999)
    assert spread["tails"] < 0.8 * spread["usual"]
