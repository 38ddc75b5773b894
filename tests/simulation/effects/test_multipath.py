"""Light by other ways than the direct one, against sums by hand."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from tofcorr.simulation.effects.base import EffectInputs
from tofcorr.simulation.effects.multipath import (
    MultipathEffect,
    MultipathShape,
    camera_over_target,
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
    for up, depth in ((0.1, 0.2), (0.4, 0.4), (1.0, 0.8)):
        for aside in (-1.4 / 3, 0.0, 1.4 / 3):
            patch = np.array([point[0] + aside, -1.1, up])
            lit, seen = patch - camera, point - patch
            first, second = np.linalg.norm(lit), np.linalg.norm(seen)
            irradiance = -lit[1] / first / first**2
            arriving = irradiance / np.pi * (1.4 / 3 * depth) * (seen[1] / second) / second**2
            arriving *= -seen[2] / second
            late = np.exp(1j * turn * (first + second - distance) / 2)
            total += arriving * late / (cosine / distance**2)
    xy, place, far, slant = (
        torch.from_numpy(np.array([v], dtype=float)) for v in (point[:2], camera, distance, cosine)
    )
    found = light_by_surfaces(xy, place, far, slant, MultipathShape(), turn)[0]
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
    places = inputs.target_xy, camera_over_target(inputs), inputs.radial_distance

    def light(factor: float) -> torch.Tensor:
        xy, camera, distance = (factor * place for place in places)
        area = MultipathShape(low_xy_m=(-factor, -factor), high_xy_m=(factor, factor))
        cosine = inputs.incidence_cosine
        return light_by_surfaces(xy, camera, distance, cosine, area, 0.8 / factor)

    torch.testing.assert_close(light(3.0), light(1.0), rtol=1e-9, atol=0.0)


def test_pixels_that_do_not_see_the_target_get_no_light_by_the_walls(inputs: EffectInputs) -> None:
    beside = inputs.target_xy.clone()
    beside[::7] = torch.nan
    effect = MultipathEffect.for_recording(inputs)
    light = effect.shares(replace(inputs, target_xy=beside))[:, :8]
    assert torch.equal((light == 0).all(1), beside[:, 0].isnan())
