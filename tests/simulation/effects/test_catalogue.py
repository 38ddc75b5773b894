"""Every effect of the catalogue obeys the same laws, in the simulator and in a fit."""

import inspect
from dataclasses import replace
from typing import Any

import pytest
import torch
from simulation.effects.scenes import Scene
from torch import Generator

from tofcorr.errors import ConfigError
from tofcorr.geometry.se3 import by_frame
from tofcorr.simulation.effects import CATALOGUE, CatalogueEffect
from tofcorr.simulation.effects.base import VELOCITY, EffectInputs

NAMES_AGREED = {
    *("distance", "pixel", "amplitude", "wiggling", "integration_time", "warm_up"),
    *("room_temperature", "ambient_light", "incidence_angle", "mixed_pixels", "multipath"),
    *("stray_light", "saturation", "fixed_pattern", "row_column_pattern", "lens"),
    *("target_shape", "target_registration", "robot_kinematics", "motion", "timestamp_offset"),
}


# The test effect is this large, metres: the derivative still holds, rounding is far below.
SIZE = 2e-4


@pytest.fixture
def scene(request: pytest.FixtureRequest, name: str) -> Scene:
    return request.getfixturevalue("moving" if VELOCITY in CATALOGUE[name].needs else "at_rest")


def _drawn(effect: CatalogueEffect, inputs: EffectInputs, generator: Generator) -> Any:
    """Return the effect with random coefficients, of the size of the test, and its slope."""
    columns = effect.slope(inputs, torch.zeros_like(effect.coefficients))
    direction = torch.randn(columns.shape[1], generator=generator, dtype=torch.float64)
    direction = direction * effect.prior_sd()
    size = float((columns @ direction).square().mean().sqrt())
    return effect.with_coefficients(direction * SIZE / size), columns


def test_the_catalogue_holds_the_names_agreed() -> None:
    assert set(CATALOGUE) >= NAMES_AGREED


@pytest.mark.parametrize("name", [n for n, e in CATALOGUE.items() if e.linear])
def test_a_linear_effect_is_its_columns_at_any_strength(name: str, scene: Scene) -> None:
    effect = CATALOGUE[name].for_recording(scene.inputs)
    strong = 3.0 * effect.prior_sd()
    shift = effect.shift(scene.inputs, strong)
    torch.testing.assert_close(shift, effect.columns(scene.inputs) @ strong, rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize(
    ("name", "inner"), [(n, inner) for n, e in CATALOGUE.items() for inner in e.contains]
)
def test_an_effect_describes_every_shift_of_those_it_contains(
    name: str, inner: str, at_rest: Scene, generator: Generator
) -> None:
    outer = CATALOGUE[name].for_recording(at_rest.inputs)
    # At the finest resolution of a map: each pixel once.
    pixel = torch.arange(32 * 24)
    every = replace(at_rest.inputs, frame=torch.zeros_like(pixel), pixel=pixel)
    if "block_px" in outer.shape.to_mapping():
        outer = type(outer)(outer.shape.model_copy(update={"block_px": 1}))
    small, _ = _drawn(CATALOGUE[inner].for_recording(every), every, generator)
    wanted = small.shift(every, small.coefficients)
    columns = outer.columns(every)
    left = wanted - columns @ torch.linalg.lstsq(columns, wanted[:, None]).solution[:, 0]
    assert float(left.abs().max()) < 1e-9 * float(wanted.abs().max())


@pytest.mark.parametrize("name", sorted(CATALOGUE))
def test_every_effect_says_what_it_is_where_from_and_what_to_record(name: str) -> None:
    effect = CATALOGUE[name]
    assert effect.name == name
    assert min(map(len, (effect.summary, effect.remedy))) > 10
    assert "\nSource: " in inspect.cleandoc(str(effect.__doc__))
    assert set(effect.contains) <= set(CATALOGUE) - {name}


@pytest.mark.parametrize("name", sorted(CATALOGUE))
def test_columns_predict_what_is_measured(name: str, scene: Scene, generator: Generator) -> None:
    effect = CATALOGUE[name].for_recording(scene.inputs)
    small, columns = _drawn(effect, scene.inputs, generator)
    change = scene.change(small)
    predicted = columns @ small.coefficients
    error = (change - predicted).square().mean().sqrt()
    # Effects act on the signal in turn, on footprints and rays: second order, a few per cent.
    assert error < 0.08 * predicted.square().mean().sqrt()


@pytest.mark.parametrize("strength", [0, 20])
@pytest.mark.parametrize("name", sorted(CATALOGUE))
def test_the_slope_is_the_derivative_of_the_shift_at_any_strength(
    name: str, strength: float, scene: Scene, generator: Generator
) -> None:
    effect = CATALOGUE[name].for_recording(scene.inputs)
    drawn = [_drawn(effect, scene.inputs, generator)[0].coefficients for _ in range(2)]
    strong, step = strength * drawn[0], 0.05 * drawn[1]
    ahead, behind = (effect.shift(scene.inputs, strong + sign * step) for sign in (1, -1))
    slope = effect.slope(scene.inputs, strong) @ step
    # The shift itself is exact to 1e-15 m; knees of taps bend within a hundredth of the step.
    torch.testing.assert_close((ahead - behind) / 2, slope, atol=1e-10, rtol=1e-5)


def test_a_product_by_frame_takes_pixels_in_any_order(generator: Generator) -> None:
    frame = torch.tensor([2, 0, 2, 2, 0])  # Frame 1 has no pixel.
    values, matrices = torch.randn(5, 3, generator=generator), torch.randn(3, 3, 4)
    expected = torch.einsum("mj,mjk->mk", values, matrices[frame])
    torch.testing.assert_close(by_frame(values, matrices, frame), expected)


@pytest.mark.parametrize("name", sorted(CATALOGUE))
def test_an_effect_without_strength_changes_nothing(name: str, scene: Scene) -> None:
    effect = CATALOGUE[name].for_recording(scene.inputs)
    change = scene.change(effect.with_coefficients(torch.zeros_like(effect.coefficients)))
    assert float(change.abs().max()) < 1e-9 + 1e-6 * float(scene.inputs.radial_distance.max())


@pytest.mark.parametrize("name", sorted(CATALOGUE))
def test_an_effect_survives_its_yaml(name: str, scene: Scene, generator: Generator) -> None:
    effect = CATALOGUE[name].for_recording(scene.inputs)
    drawn, _ = _drawn(effect, scene.inputs, generator)
    entry = drawn.to_mapping()
    assert entry.pop("name") == name
    again = CATALOGUE[name].from_mapping(entry, "test")
    assert again.shape == drawn.shape
    # Maps are listed to 1 um.
    torch.testing.assert_close(again.coefficients, drawn.coefficients, atol=6e-7, rtol=0)


@pytest.mark.parametrize(
    ("name", "key", "said"),
    [(name, "strenght", "strenght") for name in sorted(CATALOGUE)]
    + [("incidence_angle", "secand", "Did you mean 'secant'")],
)
def test_an_unknown_key_is_refused_by_name(name: str, key: str, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        CATALOGUE[name].from_mapping({key: 1.0}, "effects[0]")


def test_patterns_are_drawn_from_their_seed_alone() -> None:
    entry = {"rms_m": 0.004, "height": 6, "width": 7}
    one, same, other = (
        CATALOGUE["fixed_pattern"].from_mapping(entry | {"seed": seed}, "test").coefficients
        for seed in (5, 5, 6)
    )
    assert torch.equal(one, same)
    assert not torch.equal(one, other)


def test_wiggling_is_the_phase_error_of_a_fifth_harmonic(at_rest: Scene) -> None:
    """A harmonic of relative strength s errs by at most (c / 4 pi f) s, four times a period."""
    strength = 0.003
    effect = CATALOGUE["wiggling"].from_mapping({"sin_4": strength}, "test")
    shift = effect.shift(at_rest.inputs, effect.coefficients)
    phase = at_rest.inputs.phase
    torch.testing.assert_close(shift, strength * torch.sin(4 * phase), atol=1e-5, rtol=0)
