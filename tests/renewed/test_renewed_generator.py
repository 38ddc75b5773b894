"""Laws of the renewed generator: independent, repeatable, right in size, nothing hidden."""

import ast
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.renewed import cases
from benchmarks.renewed.forms import EFFECTS, INSIDE, OUTSIDE, forms_of
from benchmarks.renewed.generator import ranges
from benchmarks.renewed.generator.form import Form, Hook
from benchmarks.renewed.generator.measure import measure
from benchmarks.renewed.generator.recording import exactly, record
from benchmarks.renewed.generator.strength import field_of, scaled
from benchmarks.renewed.generator.world import World, draw_world
from benchmarks.renewed.generator.writing import write_recording
from benchmarks.withheld.generator.catalogue import INSIDE as FIRST_EFFECTS
from benchmarks.withheld.oracle import ask
from benchmarks.withheld.reading import read

ROOM = Path(cases.__file__).parent
RENDERED = {"rendered_floor", "rendered_corner", "rendered_gloss", "rendered_closed"}
SCALED = [one for one in INSIDE if one.textbook and one.scaled]
UNRENDERED = [one for one in (*INSIDE, *OUTSIDE) if one.name not in RENDERED | {"rendered_slab"}]


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ranges, "IMAGES", {(32, 24): 1.0})
    monkeypatch.setattr(ranges, "FRAMES", {12: 1.0})
    monkeypatch.setattr(ranges, "OUTDOOR", 0.0)


def a_world(form: Form | None = None, seed: int = 1) -> World:
    return draw_world(np.random.default_rng(seed), form.wanted if form else {"mask": "exact"})


def test_nothing_that_makes_recordings_imports_the_program() -> None:
    # `remains` runs it again, to have the models of its reports.
    for file in set(ROOM.rglob("*.py")) - {ROOM / "remains.py"}:
        names: set[str] = set()
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.Import):
                names |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                names.add(node.module or "")
        assert not {name for name in names if name.split(".")[0] == "tofcorr"}, file


def test_every_effect_of_the_first_check_has_three_forms_and_one_of_the_textbooks() -> None:
    assert set(EFFECTS) == set(FIRST_EFFECTS)
    for effect in EFFECTS:
        forms = forms_of(effect)
        assert len(forms) >= 3, effect
        assert [form.textbook for form in forms] == [True] + [False] * (len(forms) - 1)
    assert max(Counter(form.name for form in INSIDE).values()) == 1


@pytest.mark.parametrize("form", UNRENDERED, ids=lambda one: one.name)
def test_a_form_of_no_strength_changes_nothing(form: Form) -> None:
    world = a_world(form)
    change = form.draw(np.random.default_rng(2), world)
    clean = measure(world)
    changed = measure(world, [Hook(form, change, 0.0)])
    assert np.abs(field_of(changed, clean)).max() < 1e-9


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
    oracle = ask(read(tmp_path / "recording"), {}, truth.expected)
    assert oracle.plain.before_mm < 0.1


def test_without_noise_a_camera_of_several_frequencies_tells_the_path() -> None:
    world = a_world()
    world = replace(world, sensor=replace(world.sensor, frequencies=(16e6, 80e6, 120e6)))
    seen = measure(world)
    np.testing.assert_allclose(seen.depth, seen.view.path, atol=1e-9)
    np.testing.assert_allclose(seen.amplitude, seen.view.amplitude, rtol=1e-9)


def test_noise_has_the_size_that_photons_give_it() -> None:
    # One frequency f, amplitude A, B electrons a tap: c / (4 pi f) sqrt(B / 2) / A.
    world = a_world()
    sensor = replace(world.sensor, frequencies=(20e6,), spatial_filter="none", temporal_filter=0.0)
    world = replace(world, sensor=replace(sensor, tail=np.inf))
    clean, noisy = measure(world), measure(world, rng=np.random.default_rng(0))
    light = clean.view.amplitude / 0.55 + 30.0**2
    lamp = 0.15 * clean.view.bright * world.conditions.ambient[:, None, None]
    lamp = lamp * (world.conditions.exposure / 800.0)[:, None, None] * clean.view.reflectivity
    sigma = 299_792_458 / (4 * np.pi * 20e6) * np.sqrt((light + lamp) / 2) / clean.view.amplitude
    score = ((noisy.depth - clean.depth) / sigma)[clean.view.on_target]
    assert np.std(score) == pytest.approx(1.0, rel=0.03)


def test_the_camera_stays_inside_the_room() -> None:
    for seed in range(6):
        wanted = {"scene": "closed", "moving": False, "mask": "exact", "frames": 40}
        world = draw_world(np.random.default_rng(seed), wanted)
        room, where = world.surface.room, measure(world).view.origin
        assert room.floor is not None
        assert room.side is not None
        assert (where[:, 1] > room.floor).all()
        assert (np.sign(room.side) * where[:, 0] < abs(room.side)).all()


def test_a_case_is_the_same_whenever_it_is_made(tmp_path: Path) -> None:
    first = cases.write_case(7, "E", 2, tmp_path / "a")
    again = cases.write_case(7, "E", 2, tmp_path / "b")
    assert first == again
    assert cases.write_case(8, "E", 2, tmp_path / "c") != first


def test_every_form_comes_once_in_a_round() -> None:
    turns = [[cases.form_of(seed, "E", i) for i in range(len(INSIDE))] for seed in (1, 2)]
    for turn in turns:
        assert sorted(form.name for form in turn if form) == sorted(form.name for form in INSIDE)
    assert turns[0] != turns[1]
    assert cases.form_of(1, "N", 0) is None
