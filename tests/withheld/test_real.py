"""Real images keep their geometry when thinned, and take on exactly the effect that is added."""

import json
import os
from pathlib import Path

import numpy as np
import pytest

from benchmarks.withheld import real
from benchmarks.withheld.generator.catalogue import draw_effect
from benchmarks.withheld.generator.noise import NOISES
from benchmarks.withheld.generator.poses import Design
from benchmarks.withheld.generator.recording import record
from benchmarks.withheld.generator.strength import scale_to
from benchmarks.withheld.generator.world import draw_setup, draw_world
from benchmarks.withheld.generator.writing import write_recording
from benchmarks.withheld.reading import read


@pytest.fixture
def thin(tmp_path: Path) -> Path:
    rng = np.random.default_rng(0)
    world = draw_world(rng, draw_setup(rng), Design(frames=8))
    write_recording(tmp_path / "full", record(rng, world, [], NOISES["usual"])[0])
    return real.thinned(tmp_path / "full", tmp_path / "thin")


def test_a_thinned_recording_looks_along_every_third_ray(thin: Path) -> None:
    full, less = read(thin.with_name("full")), read(thin)
    np.testing.assert_allclose(less.rays, full.rays[:: real.STRIDE, :: real.STRIDE], atol=1e-9)
    np.testing.assert_array_equal(less.depth, full.depth[:, :: real.STRIDE, :: real.STRIDE])


@pytest.mark.parametrize("name", real.ADDED)
def test_an_effect_added_to_images_has_its_size(thin: Path, name: str) -> None:
    data = read(thin)
    _, field = scale_to(real.real_view(data), draw_effect(name, np.random.default_rng(0)), 4e-3)
    assert np.sqrt(np.mean(field[data.valid] ** 2)) == pytest.approx(4e-3, rel=0.02)


@pytest.mark.slow
@pytest.mark.skipif("TOFCORR_REAL_DATA" not in os.environ, reason="$TOFCORR_REAL_DATA is not set")
def test_real_images_differ_from_the_plain_ones_by_the_sealed_effect(tmp_path: Path) -> None:
    names = list(real.generate_real(1, tmp_path))
    answers = {
        name: json.loads((tmp_path / "answers" / name / "answer.json").read_text())
        for name in names
    }
    (plain,) = [name for name, one in answers.items() if one["role"] == "plain"]
    before = read(tmp_path / "recordings" / plain)
    for name, one in answers.items():
        after = read(tmp_path / "recordings" / name)
        change = (after.depth - before.depth)[before.valid]
        wanted = next(iter(one["sizes_mm"].values()), 0.0)
        assert 1e3 * np.sqrt(np.mean(change**2)) == pytest.approx(wanted, rel=1e-3, abs=1e-4)
