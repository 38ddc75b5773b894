"""Light by other ways than the direct one, against sums by hand."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from tofcorr.simulation.effects.inputs import EffectInputs
from tofcorr.simulation.effects.multipath import (
    MultipathEffect,
    MultipathShape,
    Seen,
    camera_over_target,
    in_every_pixel,
    light_by_surfaces,
)


def _only(effect: MultipathEffect, start: str) -> torch.Tensor:
    """Return a tenth of the coefficients whose names start like this, and zero of the others."""
    names = [term.name for term in effect.terms(effect.shape)]
    return torch.tensor([0.1 * name.startswith(start) for name in names], dtype=torch.float64)


def test_light_by_a_floor_is_the_sum_over_its_patches() -> None:
    """A camera 1.2 m before the target, and a floor 0.2 m below the area seen, of width 2 m."""
    turn, camera, point = 0.8, np.array([0.1, 0.2, 1.2]), np.array([0.3, -0.4, 0.0])
    ray = point - camera
    distance = float(np.linalg.norm(ray))
    cosine = -ray[2] / distance
    total = 0.0j
    for up, depth in ((0.1, 0.2), (0.3, 0.3), (0.8, 0.7)):
        for aside in (-0.5, 0.0, 0.5):
            patch = np.array([point[0] + aside, -1.1, up])
            lit, seen = patch - camera, point - patch
            first, second = np.linalg.norm(lit), np.linalg.norm(seen)
            irradiance = -lit[1] / first / first**2
            arriving = irradiance / np.pi * (0.5 * depth) * (seen[1] / second) / second**2
            arriving *= -seen[2] / second
            late = np.exp(1j * turn * (first + second - distance) / 2)
            total += arriving * late / (cosine / distance**2)
    seen_point = Seen(
        torch.tensor(point[None, None, :2]),
        torch.tensor([[distance]], dtype=torch.float64),
        torch.tensor([[cosine]], dtype=torch.float64),
        torch.tensor(camera[None]),
    )
    found = light_by_surfaces(seen_point, ((-1.0, -1.0), (1.0, 1.0)), turn)[0, 0]
    names = [term.name for term in MultipathEffect.terms(MultipathShape())]
    below = found[names.index("below_near")]
    # The first surface is 0.05 of the width beyond the edge.
    np.testing.assert_allclose(complex(below), total, rtol=1e-12)


@pytest.mark.parametrize("way", ["below", "left", "room_x0_y0", "flange"])
def test_light_by_another_way_comes_later(inputs: EffectInputs, way: str) -> None:
    """Up to a quarter of a period: beyond it, the sign of a sine turns."""
    effect = MultipathEffect.for_recording(inputs)
    assert float(effect.shift(inputs, _only(effect, way)).min()) > 0.0


def test_light_of_an_even_room_grows_as_the_direct_light_falls(inputs: EffectInputs) -> None:
    effect = MultipathEffect.for_recording(inputs)
    weak = 1e-6 * (_only(effect, "room_x0_y0") - _only(effect, "room_x0_y0_distance"))
    shift = effect.shift(inputs, weak)
    direct = inputs.incidence_cosine / inputs.radial_distance**2
    torch.testing.assert_close(shift * direct, (shift * direct)[:1].expand_as(shift))


def test_light_by_other_ways_does_not_know_the_scale_of_the_scene(inputs: EffectInputs) -> None:
    effect = MultipathEffect.for_recording(inputs)
    low, high = effect.shape.low_xy_m, effect.shape.high_xy_m
    camera = camera_over_target(inputs)[inputs.frame]

    def light(factor: float) -> torch.Tensor:
        seen = Seen(
            factor * inputs.target_xy[:, None],
            factor * inputs.radial_distance[:, None],
            inputs.incidence_cosine[:, None],
            factor * camera,
        )
        area = (factor * low[0], factor * low[1]), (factor * high[0], factor * high[1])
        return light_by_surfaces(seen, area, 0.8 / factor)

    torch.testing.assert_close(light(3.0), light(1.0), rtol=1e-9, atol=0.0)


def test_polynomials_over_the_target_are_near_what_they_replace(inputs: EffectInputs) -> None:
    """Every surface by itself, in every pixel, to a thousandth of its size."""
    camera = camera_over_target(inputs)[inputs.frame]
    pixels = Seen(
        inputs.target_xy[:, None],
        inputs.radial_distance[:, None],
        inputs.incidence_cosine[:, None],
        camera,
    )
    low, high = inputs.target_xy.amin(0).tolist(), inputs.target_xy.amax(0).tolist()
    area = (low[0], low[1]), (high[0], high[1])

    def light(seen: Seen) -> torch.Tensor:
        return light_by_surfaces(seen, area, 0.8).imag

    exact = light(pixels)[:, 0]
    error = (in_every_pixel(light, inputs, 8) - exact).square().mean(0).sqrt()
    assert bool((error < 1e-3 * exact.square().mean(0).sqrt()).all())


def test_pixels_that_do_not_see_the_target_get_no_light_by_the_walls(inputs: EffectInputs) -> None:
    beside = inputs.target_xy.clone()
    beside[::7] = torch.nan
    partly = replace(inputs, target_xy=beside)

    def one(seen: Seen) -> torch.Tensor:
        return torch.ones_like(seen.distance)[..., None]

    found = in_every_pixel(one, partly, 1)[:, 0]
    torch.testing.assert_close(found, torch.where(beside[:, 0].isnan(), 0.0, 1.0).double())
