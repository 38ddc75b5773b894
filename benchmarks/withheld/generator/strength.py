"""Effects scaled to a wanted size of error."""

from collections.abc import Callable

import numpy as np

from benchmarks.withheld.generator.effect import Applied, Effect
from benchmarks.withheld.generator.observe import View, demodulate, taps_of, trace
from benchmarks.withheld.generator.rigid import Array

TOLERANCE = 0.003


def error_field(view: View, applied: Applied) -> Array:
    """Change of the measured distance (N, H, W), metres, that one effect alone brings to a view."""
    world, effect = view.world, applied.effect
    if effect.stage == "path":
        return effect.change(applied.strength, view, np.zeros_like(view.distance))
    if effect.stage in ("poses", "rays", "plane", "relief"):
        return trace(world, [applied]).target_distance - view.target_distance
    full = world.camera.unambiguous_range
    if effect.stage == "light":
        turned = effect.change(applied.strength, view, view.phasor) * np.conj(view.phasor)
        return np.angle(turned) / (2 * np.pi) * full
    difference = demodulate(taps_of(view, [applied]), full)[0] - view.path
    return (difference + full / 2) % full - full / 2


def scale_to(view: View, effect: Effect, size: float) -> tuple[Applied, Array]:
    """Find the strength at which the field's RMS over used pixels is `size` metres, and the field.

    An effect that cannot become so large is returned at the largest size met.
    """
    used = view.used
    best: dict[str, tuple[float, float, Array]] = {}

    def rms(strength: float) -> float:
        field = error_field(view, Applied(effect, strength))
        value = float(np.sqrt(np.mean(field[used] ** 2)))
        if "best" not in best or abs(np.log(max(value, 1e-12) / size)) < best["best"][0]:
            best["best"] = abs(np.log(max(value, 1e-12) / size)), strength, field
        return value

    _solve(rms, effect.guess, size)
    _, strength, field = best["best"]
    return Applied(effect, strength), field


def _solve(rms: Callable[[float], float], guess: float, size: float) -> None:
    """Evaluate `rms` at better strengths: proportional steps, then regula falsi on logarithms."""
    strength, low, high = guess, None, None
    for _ in range(40):
        value = rms(strength)
        if abs(value / size - 1) < TOLERANCE:
            return
        point = np.log(strength), np.log(max(value, 1e-12) / size)
        low, high = (point, high) if value < size else (low, point)
        if low is None or high is None:
            strength *= np.clip(size / max(value, 1e-12), 0.25, 4.0)
            continue
        share = np.clip(low[1] / (low[1] - high[1]), 0.1, 0.9)
        strength = float(np.exp(low[0] + share * (high[0] - low[0])))
