"""A hand-eye transform from nothing."""

from dataclasses import replace

import torch
from synthetic_scene import EA, make_scene
from torch import Generator

from tofcorr.estimation.moments import MomentObjective, Parameters
from tofcorr.estimation.solvers import initial_parameters, rotation_from_normals, with_linear_part
from tofcorr.geometry import se3
from tofcorr.geometry.rays import planes_through


def test_planes_are_fitted_to_the_points_of_each_image(generator: Generator) -> None:
    scene = make_scene(generator, noise=0.0, error_size=0.0)
    moments = scene.moments()
    expected = moments.normal_tool @ scene.truth.tool_from_camera[:3, :3]
    # Second moments of 1 m^2 tell a spread of 0.01 m^2 to 1e-14.
    points = moments.gram[:, [0, 1, 2, -1]][:, :, [0, 1, 2, -1]]
    found, offset = planes_through(points, torch.zeros(3).double())
    torch.testing.assert_close(found, expected, rtol=0.0, atol=1e-12)
    lever = moments.normal_tool @ scene.truth.tool_from_camera[:3, 3]
    torch.testing.assert_close(offset, moments.offset_tool + lever, rtol=0.0, atol=1e-12)


def test_error_free_data_give_the_hand_eye_from_nothing(generator: Generator) -> None:
    scene = make_scene(generator, EA, noise=0.0, error_size=0.0)
    true = scene.truth.tool_from_camera
    found = initial_parameters(scene.moments()).tool_from_camera
    # The guess (the identity) weighs a millionth of an image, and turns the result that little.
    torch.testing.assert_close(found, true, rtol=0.0, atol=1e-5)
    knowing = initial_parameters(scene.moments(), true).tool_from_camera
    torch.testing.assert_close(knowing, true, rtol=0.0, atol=1e-10)


def test_parallel_normals_leave_the_turn_about_them_to_the_guess(generator: Generator) -> None:
    normal = torch.tensor([[0.0, 0.0, -1.0]], dtype=torch.float64).expand(5, 3)
    turn = se3.exp(torch.tensor([0, 0, 0, 0, 0, 0.7], dtype=torch.float64))[:3, :3]
    tilt = se3.exp(torch.tensor([0, 0, 0, 0.2, 0, 0], dtype=torch.float64))[:3, :3]
    found = rotation_from_normals(normal, normal @ tilt, turn)
    torch.testing.assert_close(normal @ found, normal @ tilt, rtol=0.0, atol=1e-6)
    # Of all such rotations it is the nearest to the guess: none about the normal is nearer.
    for angle in (-0.01, 0.01):
        twist = torch.tensor([0, 0, 0, 0, 0, angle], dtype=torch.float64)
        other = se3.exp(twist)[:3, :3] @ found
        assert (other - turn).norm() > (found - turn).norm()


def test_the_linear_part_is_the_optimum_at_that_rotation(generator: Generator) -> None:
    scene = make_scene(generator, EA)
    moments = scene.moments()
    zero = torch.zeros_like(scene.truth.coefficients)
    start = replace(scene.truth, coefficients=zero)
    found = with_linear_part(moments, start)
    gradient = MomentObjective(moments).normal_equations(found).gradient
    before = MomentObjective(moments).normal_equations(start).gradient
    linear = [0, 1, 2, *range(6, found.size)]
    assert float(gradient[linear].norm()) < 1e-9 * float(before[linear].norm())
    assert torch.equal(found.tool_from_camera[:3, :3], start.tool_from_camera[:3, :3])


def test_with_a_fixed_hand_eye_only_coefficients_are_solved_for(generator: Generator) -> None:
    scene = make_scene(generator, EA, noise=0.0)
    zero = torch.zeros_like(scene.truth.coefficients)
    start = Parameters(scene.truth.tool_from_camera, zero, hand_eye_is_free=False)
    found = with_linear_part(scene.moments(), start)
    assert torch.equal(found.tool_from_camera, start.tool_from_camera)
    torch.testing.assert_close(found.coefficients, scene.truth.coefficients, rtol=0.0, atol=1e-9)
    # Without coefficients nothing is left to solve.
    known = replace(start, coefficients=torch.zeros(0).double())
    found = with_linear_part(scene.moments().columns([]), known)
    assert torch.equal(found.tool_from_camera, known.tool_from_camera)


def test_a_column_of_zeros_changes_nothing_and_stays_zero(generator: Generator) -> None:
    # A condition that never changed: where rounding mixed its direction with others, its
    # coefficient came out as 5e120, and no number of the fit was finite any more.
    plain = make_scene(generator, EA).moments()
    functions = torch.linspace(0.0, 1.0, len(plain.gram), dtype=torch.float64)[:, None]
    functions = torch.cat([functions, functions.square()], dim=1)
    expected = initial_parameters(plain.with_conditions(functions, ["h1", "w1"]))
    with_zeros = torch.cat([torch.zeros_like(functions[:, :1]), functions], dim=1)
    found = initial_parameters(plain.with_conditions(with_zeros, ["e1", "h1", "w1"]))
    others = [*range(len(found.coefficients) - 3), -2, -1]
    assert float(found.coefficients[-3]) == 0.0
    torch.testing.assert_close(found.coefficients[others], expected.coefficients)
    torch.testing.assert_close(found.tool_from_camera, expected.tool_from_camera)
