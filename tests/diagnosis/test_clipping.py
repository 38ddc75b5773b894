"""Clipped pixels: named where three images of fifty hold them, and where none does nothing."""

from pathlib import Path
from typing import Any

import pytest
from diagnosed_recordings import recorded
from optional import present

from tofcorr.data.recording import Recording
from tofcorr.diagnosis.diagnose import prepare
from tofcorr.diagnosis.findings.naming import name_effects
from tofcorr.diagnosis.options import DiagnosisOptions
from tofcorr.diagnosis.sums.observations import observe
from tofcorr.simulation.effects.saturation import light_of

DIM = {"sensor": {"light": {"electrons_at_1m": 300_000.0}}}
KNEE = {"knees": [1.0], "softness": 0.02, "knee_1": 1.0}
CLIP: dict[str, Any] = {"name": "saturation", "full_counts": 40_000.0, **KNEE}


@pytest.fixture(scope="module")
def straight(folder: Path) -> Recording:
    return recorded(folder / "straight", 50, [], DIM)


def _three_images_clipped(folder: Path, seed: int) -> Recording:
    straight = recorded(folder / f"straight_{seed}", seed, [], DIM)
    images = present(observe(straight, 1000).amplitude_images)
    fourth = float(images.flatten(1).amax(1).sort(descending=True).values[3])
    # The brightest tap of a pixel without ambient light: A (1 + 1 / contrast).
    clip = CLIP | {"full_counts": 3.0 * fourth}
    return recorded(folder / f"clipped_{seed}", seed, [clip], DIM)


def _names_saturation(recording: Recording) -> bool:
    study = prepare(recording, DiagnosisOptions(), None).study
    return any("saturation" in members for members in name_effects(study).cause_sets)


@pytest.mark.parametrize("last", [50, pytest.param(55, marks=pytest.mark.slow)])
def test_clipping_that_three_images_of_fifty_hold_is_named(last: int, tmp_path: Path) -> None:
    """All but one of six times at least."""
    seeds = range(50, last + 1)
    named = [_names_saturation(_three_images_clipped(tmp_path, seed)) for seed in seeds]
    assert sum(named) >= 5 * len(named) / 6


def test_nothing_is_called_saturation_where_nothing_clips(straight: Recording) -> None:
    assert not _names_saturation(straight)


def test_the_light_of_clipped_pixels_is_recovered(straight: Recording, tmp_path: Path) -> None:
    light = present(observe(straight, 10_000_000).amplitude_images)
    clipped = recorded(tmp_path / "clipped", 50, [CLIP], DIM)
    study = prepare(clipped, DiagnosisOptions(), None).study
    inputs = study.inputs
    true = light.flatten(1)[inputs.frame, inputs.pixel].double()
    lost = inputs.known_amplitude < 0.9 * true
    assert int(lost.sum()) > 100
    recorded_error = (inputs.known_amplitude / true).log()[lost].square().mean().sqrt()
    error = (light_of(inputs) / true).log()[lost].square().mean().sqrt()
    assert error < 0.5 * recorded_error
    assert ((light_of(inputs) / true - 1).abs() < 0.1)[~lost].double().mean() > 0.98
