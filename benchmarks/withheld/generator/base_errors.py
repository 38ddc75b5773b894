"""The errors every camera has, in distance, pixel and amplitude; none written as a polynomial.

The `smooth` forms (exponentials, a hyperbolic bowl) lie within hundredths of a millimetre of a
cubic in distance, quadratics in row and column and a quadratic in amplitude over the range of a
scene, so a base model of that kind is right. Each `wrong` form bends more than that.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from benchmarks.withheld.generator.rigid import Array

BASE_FORMS = ("smooth", "distance", "pixel", "amplitude")


@dataclass(frozen=True)
class BaseErrors:
    """Errors in metres; amplitudes are over a white target's at 1 m, positions in (-1, 1)."""

    of_distance: Callable[[Array], Array]
    of_pixel: Callable[[Array, Array], Array]
    of_amplitude: Callable[[Array], Array]


def draw_base_errors(rng: np.random.Generator, wrong: str = "smooth") -> BaseErrors:
    """Draw centimetres of error; `wrong` names the one that no low polynomial fits, or `smooth`."""
    near, decay, slope = (
        rng.uniform(0.02, 0.05) * rng.choice([-1, 1]),
        rng.uniform(1.0, 1.6),
        rng.normal(0, 0.01),
    )
    offset, knee = rng.normal(0, 0.02), rng.uniform(0.9, 1.5)
    bowl, tilt_c, tilt_r = rng.uniform(0.1, 0.25), rng.normal(0, 0.004), rng.normal(0, 0.004)
    dark, fade = rng.uniform(0.012, 0.03), rng.uniform(11.0, 16.0)
    middle = rng.uniform(-0.2, 0.2, 2)
    bend = rng.uniform(2.0, 5.0) * 1e-3 * rng.choice([-1, 1])

    def of_distance(d: Array) -> Array:
        smooth = offset + near * np.exp(-d / decay) + slope * d
        return smooth + (
            3 * bend * np.tanh(np.maximum(d - knee, 0.0) / 0.12) if wrong == "distance" else 0.0
        )

    def of_pixel(column: Array, row: Array) -> Array:
        square = (column - middle[0]) ** 2 + (row - middle[1]) ** 2
        smooth = bowl * 4 * (np.sqrt(1 + square / 60) - 1) + tilt_c * column + tilt_r * row
        angle = 3 * np.arctan2(row, column)
        return smooth + (1.2 * bend * np.sin(angle) * square**1.5 if wrong == "pixel" else 0.0)

    def of_amplitude(a: Array) -> Array:
        smooth = -dark * np.exp(-a / fade)
        return smooth - (1.5 * abs(bend) / (0.25 + a) if wrong == "amplitude" else 0.0)

    return BaseErrors(of_distance, of_pixel, of_amplitude)
