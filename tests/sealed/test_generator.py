"""Laws of the generator of recordings: independent, repeatable, right in size, nothing hidden."""

from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from import_graph import imported
from optional import present
from sealed.perfect_robot import exactly

from benchmarks import sealed
from benchmarks.renewed import cases
from benchmarks.renewed.cases import in_world, make_case, seeded, turn
from benchmarks.renewed.forms import EFFECTS, INSIDE, OUTSIDE
from benchmarks.renewed.geometry import Camera, inverse, small_motions
from benchmarks.renewed.recording import read, record, write_recording
from benchmarks.renewed.rendering import smooth
from benchmarks.renewed.signal_chain import Form, Hook, demodulate, field_of, measure, scaled
from benchmarks.renewed.world import World, draw_world, session_again
from benchmarks.sealed.oracle import ask
from benchmarks.withheld.tiers import TIERS
from benchmarks.withheld.tiers import write_case as write_tier
from tofcorr.data.recording import Recording

ROOM, SEALED = Path(cases.__file__).parent, Path(sealed.__file__).parent
RENDERED = {"rendered_floor", "rendered_corner", "rendered_gloss", "rendered_closed"}
SCALED = [one for one in INSIDE if one.textbook and one.scaled]
UNRENDERED = [one for one in (*INSIDE, *OUTSIDE) if one.name not in RENDERED | {"rendered_slab"}]


def a_world(form: Form | None = None, seed: int = 1, **wanted: object) -> World:
    wanted = dict(form.wanted) if form else {"mask": "exact"} | wanted
    return draw_world(np.random.default_rng(seed), wanted)


def test_nothing_that_makes_recordings_or_judges_imports_the_program() -> None:
    # Two run it: for its diagnoses, and to have the models of its reports.
    for file in {*ROOM.rglob("*.py"), *SEALED.glob("*.py")} - {
        SEALED / one for one in ("remains.py", "running.py")
    }:
        assert not {one for one in imported(file.read_text()) if one.startswith("tofcorr")}, file


def test_every_effect_has_three_forms_and_one_of_the_textbooks() -> None:
    for effect in EFFECTS:
        forms = [form for form in INSIDE if form.effect == effect]
        assert len(forms) >= 3, effect
        assert [form.textbook for form in forms] == [True] + [False] * (len(forms) - 1)
    assert max(Counter(form.name for form in INSIDE).values()) == 1


@pytest.mark.parametrize("form", UNRENDERED, ids=lambda one: one.name)
def test_a_form_of_no_strength_changes_nothing(form: Form) -> None:
    world = a_world(form)
    change = form.draw(np.random.default_rng(2), world)
    changed = measure(world, [Hook(form, change, 0.0)])
    assert np.abs(field_of(changed, measure(world))).max() < 1e-9


@pytest.mark.parametrize("form", SCALED, ids=lambda one: one.effect)
def test_the_error_of_a_textbook_form_has_the_size_asked_for(form: Form) -> None:
    world = a_world(form)
    hook = scaled(world, form, form.draw(np.random.default_rng(2), world), 4e-3)
    clean = measure(world)
    error = field_of(measure(world, [hook]), clean)[clean.view.on_target]
    assert np.sqrt(np.mean(error**2)) == pytest.approx(4e-3, rel=0.03)


@pytest.mark.parametrize("seed", [3, 4, 5])
def test_with_nothing_missing_the_base_model_leaves_nothing(seed: int, tmp_path: Path) -> None:
    rng = np.random.default_rng(seed)
    world = draw_world(rng, {"mask": "exact, two pixels less", "frames": 30})
    recorded, truth = record(rng, world, [])
    write_recording(tmp_path / "recording", exactly(rng, recorded, truth))
    assert ask(read(tmp_path / "recording"), {}, truth.expected).before_mm < 0.1


def test_without_noise_a_camera_of_several_frequencies_tells_the_path() -> None:
    world = a_world()
    world = replace(world, sensor=replace(world.sensor, frequencies=(16e6, 80e6, 120e6)))
    seen = measure(world)
    np.testing.assert_allclose(seen.depth, seen.view.path, atol=1e-9)
    np.testing.assert_allclose(seen.amplitude, seen.view.amplitude, rtol=1e-9)


@pytest.mark.parametrize("tail", [np.inf, 6.0])
def test_noise_has_the_size_that_photons_give_it(tail: float) -> None:
    # One frequency f, amplitude A, B electrons a tap: c / (4 pi f) sqrt(B / 2) / A.
    world = a_world()
    sensor = replace(world.sensor, frequencies=(20e6,), spatial_filter="none", temporal_filter=0.0)
    world = replace(world, sensor=replace(sensor, tail=tail))
    clean, noisy = measure(world), measure(world, rng=np.random.default_rng(0))
    light = clean.view.amplitude / 0.55 + 30.0**2
    lamp = 0.15 * clean.view.bright * world.conditions.ambient[:, None, None]
    lamp = lamp * (world.conditions.exposure / 800.0)[:, None, None] * clean.view.reflectivity
    sigma = 299_792_458 / (4 * np.pi * 20e6) * np.sqrt((light + lamp) / 2) / clean.view.amplitude
    score = ((noisy.depth - clean.depth) / sigma)[clean.view.on_target]
    assert np.std(score) == pytest.approx(1.0, rel=0.03)


def test_four_samples_by_hand() -> None:
    phase, amplitude = demodulate(np.array([7.0, 5.0, 3.0, 9.0])[:, None, None, None])
    assert phase.item() == pytest.approx(np.pi / 4)
    assert amplitude.item() == pytest.approx(np.hypot(2, 2))


def test_the_camera_stays_inside_the_room() -> None:
    for seed in range(6):
        world = a_world(None, seed, scene="closed", moving=False, frames=40)
        room, where = world.surface.room, measure(world).view.origin
        side = present(room.side)
        assert (where[:, 1] > present(room.floor)).all()
        assert (np.sign(side) * where[:, 0] < abs(side)).all()


def test_rays_project_back_to_their_pixels() -> None:
    lens = (-0.11, 0.03, 4e-4, -3e-4, 0.0)
    camera = Camera(56, 40, (70.0, 70.1), (28.0, 19.0), lens, 1.0, 1.0)
    x, y, z = np.moveaxis(camera.rays(), -1, 0)
    a, b, (k1, k2, p1, p2, k3) = x / z, y / z, lens
    r = a * a + b * b
    radial = 1 + k1 * r + k2 * r**2 + k3 * r**3
    u = a * radial + 2 * p1 * a * b + p2 * (r + 2 * a * a)
    v = b * radial + p1 * (r + 2 * b * b) + 2 * p2 * a * b
    columns, rows = np.meshgrid(np.arange(56), np.arange(40))
    np.testing.assert_allclose(70.0 * u + 28.0, columns, atol=1e-6)
    np.testing.assert_allclose(70.1 * v + 19.0, rows, atol=1e-6)


def test_a_motion_and_its_inverse_leave_everything_in_place() -> None:
    vectors = np.random.default_rng(0).normal(size=(20, 3))
    motions = small_motions(vectors, vectors[::-1])
    np.testing.assert_allclose(inverse(motions) @ motions, np.eye(4) + 0 * motions, atol=1e-12)


def test_smoothing_keeps_a_polynomial_and_its_values_on_the_grid() -> None:
    line = np.linspace(-1, 1, 9)
    values = 1 + 2 * line[:, None] - 1j * line**3
    np.testing.assert_allclose(smooth(values, line, line), values, atol=1e-12)


def test_every_form_comes_once_in_a_round() -> None:
    rounds = [[turn(seed, INSIDE, i).name for i in range(len(INSIDE))] for seed in (1, 2)]
    assert sorted(rounds[0]) == sorted(rounds[1]) == sorted(form.name for form in INSIDE)
    assert rounds[0] != rounds[1]


@pytest.mark.parametrize("tier", TIERS)
def test_recordings_of_every_tier_are_valid_and_repeatable(tier: str, tmp_path: Path) -> None:
    entries = list(write_tier(3, tier, 3, tmp_path / "a"))
    assert entries == list(write_tier(3, tier, 3, tmp_path / "b"))
    assert entries != list(write_tier(4, tier, 3, tmp_path / "c"))
    names = {"recording.yaml", "frames.csv", "depth.npy", "amplitude.npy", "mask.npy"}
    for entry in entries:
        folder = tmp_path / "a" / "recordings" / entry["id"]
        Recording.open(folder)
        assert {file.name for file in folder.iterdir()} <= names


def test_withheld_columns_and_entries_are_not_written(tmp_path: Path) -> None:
    case = make_case(np.random.default_rng(0))
    without = ("ambient", "amplitude.npy", "modulation_frequency_hz")
    write_recording(tmp_path / "r", case.recorded, without)
    data = read(tmp_path / "r")
    assert data.amplitude is None
    assert "ambient" not in data.columns
    assert "modulation" not in (tmp_path / "r" / "recording.yaml").read_text()


def test_recorded_again_the_effect_is_as_strong_but_the_session_another() -> None:
    (pattern,) = seeded([form for form in INSIDE if form.name == "every_pixel"], 5)
    case = make_case(np.random.default_rng(0), [pattern])
    world = session_again(np.random.default_rng(1), case.world, frames=20)
    (hook,) = in_world(world, case.hooks)
    assert world.frames == 20
    first, again = (one.way.camera_at(np.zeros(one.frames)) for one in (case.world, world))
    assert not np.allclose(first, again[: len(first)])
    fields = [
        field_of(measure(one, [own]), measure(one))
        for one, own in ((world, hook), (case.world, case.hooks[0]))
    ]
    means = [np.where(field == 0, np.nan, field) for field in fields]
    first, again = (np.nanmean(field, axis=0) for field in means)
    np.testing.assert_allclose(first, again, atol=1e-12)
