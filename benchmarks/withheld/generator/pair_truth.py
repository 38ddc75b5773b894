"""What is true of a pair: the gap as given, and the share of each cause in its square.

The expected frames differ by a sum of parts, one a cause. The Shapley value of a part in the
square of a sum is its inner product with the sum (`shares`); these add up to the square.

Which cause a constant has cannot be seen: an offset of the camera, a shift along its axis and the
mean of an effect look alike. A constant over all pixels counts as `distance` (`centred_parts`).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks.withheld.generator.effect import Applied
from benchmarks.withheld.generator.noise import distance_sigma
from benchmarks.withheld.generator.observe import View, demodulate, look, taps_of
from benchmarks.withheld.generator.rigid import Array
from benchmarks.withheld.generator.world import World


@dataclass(frozen=True)
class Expected:
    """A world without noise: the views without effects and with, distance and noise with them."""

    plain: View
    seen: View
    distance: Array  # (N, H, W), metres
    sigma: Array  # (N, H, W), standard deviation of the noise, metres

    @property
    def used(self) -> np.ndarray:
        """Pixels (N, H, W) on the target, with the effects and without."""
        return self.plain.used & self.seen.used

    @property
    def effects(self) -> Array:
        """What the effects add together, metres."""
        full = self.plain.world.camera.unambiguous_range
        return (self.distance - self.plain.path + full / 2) % full - full / 2


def expect(world: World, effects: Sequence[Applied]) -> Expected:
    """Observe a world without noise."""
    seen = look(world, effects)
    full = world.camera.unambiguous_range
    taps = taps_of(seen, effects)
    sigma = distance_sigma(taps, full / (2 * np.pi))
    return Expected(look(world), seen, demodulate(taps, full)[0], sigma)


def parts_of(real: Expected, simulated: Expected, effect: str) -> dict[str, Array]:
    """Parts (M,) of camera minus simulator over the pixels that both use, metres.

    `effect` names the part that is neither hand-eye nor a base term. The constant of the base terms
    is counted as `distance`; hand-eye and effect keep theirs.
    """
    used = real.used & simulated.used
    terms = [base_terms(one.plain) for one in (real, simulated)]
    parts = {name: (terms[0][name] - terms[1][name])[used] for name in terms[0]}
    for name in ("pixel", "amplitude"):
        mean = parts[name].mean()
        parts[name] = parts[name] - mean
        parts["distance"] = parts["distance"] + mean
    parts["hand_eye"] = (real.plain.distance - simulated.plain.distance)[used]
    if effect:
        parts[effect] = parts.get(effect, 0.0) + (real.effects - simulated.effects)[used]
    return parts


def base_terms(view: View) -> dict[str, Array]:
    """Base errors (N, H, W) by term, metres."""
    base, shape = view.world.setup.base, view.distance.shape
    return {
        "distance": base.of_distance(view.distance),
        "pixel": np.broadcast_to(base.of_pixel(*view.world.pixel_position), shape),
        "amplitude": base.of_amplitude(view.relative_amplitude),
    }


def centred_parts(parts: Mapping[str, Array]) -> dict[str, Array]:
    """The parts, with the mean of each counted as distance."""
    centred = {name: part - part.mean() for name, part in parts.items()}
    constant = sum(part.mean() for part in parts.values())
    return {**centred, "distance": centred["distance"] + constant}


def shares(parts: Mapping[str, Array]) -> dict[str, float]:
    """Shapley shares of the parts in the square of their sum; they sum to one."""
    total = sum(parts.values(), np.zeros(1))
    square = float(np.sum(total**2))
    return {name: float(np.sum(part * total)) / square for name, part in parts.items()}


def size_mm(parts: Mapping[str, Array]) -> float:
    """Root mean square of the parts' sum, millimetres."""
    total = sum(parts.values(), np.zeros(1))
    return 1e3 * float(np.sqrt(np.mean(total**2)))
