"""How strong a form must be for the error that is asked for."""

from collections.abc import Callable

import numpy as np

from benchmarks.renewed.generator.form import Change, Form, Hook
from benchmarks.renewed.generator.measure import Measured, measure
from benchmarks.renewed.generator.view import see
from benchmarks.renewed.generator.world import World
from benchmarks.withheld.generator.rigid import Array

TOLERANCE = 0.01
STEPS = 14
COARSE = 9  # rows and columns of the grid on which light is rendered


def scaled(world: World, form: Form, change: Change, size: float) -> Hook:
    """The form at the strength at which its error's RMS over the target is `size` metres.

    A form that cannot become so large is returned at the nearest size met. What is rendered comes
    at strength 1.
    """
    if not form.scaled:
        return Hook(form, change, 1.0)
    clean = measure(world)

    def size_at(strength: float) -> float:
        error = field_of(measure(world, [Hook(form, change, strength)]), clean)
        return float(np.sqrt(np.mean(error[clean.view.on_target] ** 2)))

    return Hook(form, change, strength_for(size_at, form.guess, size))


def strength_for(size_at: Callable[[float], float], guess: float, size: float) -> float:
    """The strength at which `size_at` is nearest to a size, by proportion and then by halving."""
    strength, low, high, best = guess, None, None, (np.inf, guess)
    for _ in range(STEPS):
        miss = float(np.log(max(size_at(strength), 1e-9) / size))
        best = min(best, (abs(miss), strength))
        if abs(miss) < TOLERANCE:
            break
        low, high = (strength, high) if miss < 0 else (low, strength)
        if low is None or high is None:
            strength *= float(np.clip(np.exp(-miss), 0.2, 5.0))
        else:
            strength = float(np.sqrt(low * high))
    return best[1]


def field_of(changed: Measured, clean: Measured) -> Array:
    """Change of the measured depth (N, H, W), metres; zero where either does not see the target."""
    both = changed.view.on_target & clean.view.on_target
    return np.where(both, changed.depth - clean.depth, 0.0)


def coarse_view(world: World) -> tuple[Array, Array]:
    """Camera positions (N, 3) and points on the target's plane (N, 9, 9, 3), its frame."""
    lens, (x, y) = world.sensor.lens, world.sensor.lens.slopes()
    rows, columns = (
        np.linspace(0, n - 1, COARSE).round().astype(int) for n in (lens.height, lens.width)
    )
    view = see(world, slopes=np.stack([x, y])[:, rows[:, None], columns])
    return view.origin, np.stack([view.x, view.y, np.zeros_like(view.x)], axis=-1)
