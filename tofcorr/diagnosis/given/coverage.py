"""What a simulator that saw other poses covers of a recording."""

from torch import Tensor

from tofcorr.simulation.effects.inputs import EffectInputs

# Share of a variable's values that its range leaves out at each end, against single gross errors.
# Chosen.
_OUTSIDE = 0.001
# A range counts as covered this far beyond its ends, as a share of it. Chosen: a low polynomial
# hardly leaves its course there.
_MARGIN = 0.05
# Amplitude scales that differ by less than this share are the same. Chosen: the median of other
# poses varies so much.
_SAME_SCALE = 0.05
# Shares of pixels beyond a range below this are not worth a warning. Chosen.
_WORTH_A_WARNING = 0.001


def amplitude_scale(real: EffectInputs, targets: Tensor, simulated: EffectInputs) -> float:
    """Return the recording's amplitude over the simulator's, of like pixels; 1 if they agree.

    An amplitude falls with the square of the distance and the cosine of the incidence; what remains
    is compared by its median.

    Args:
        real: Of the recording.
        targets: Whether a pixel's target was simulated as well, shape (M,), bool.
        simulated: Of the simulator's frames.
    """
    if real.amplitude is None or simulated.amplitude is None or not bool(targets.any()):
        return 1.0
    ratio = float(_brightness(real)[targets].median() / _brightness(simulated).median())
    return 1.0 if abs(ratio - 1) < _SAME_SCALE or not ratio > 0 else ratio


def _brightness(inputs: EffectInputs) -> Tensor:
    cosine = inputs.incidence_cosine.clamp(min=1e-3)
    return inputs.known_amplitude * inputs.radial_distance**2 / cosine


def beyond(name: str, real: Tensor, simulated: Tensor) -> tuple[Tensor, list[str]]:
    """Return which pixels lie beyond the simulator's range of a variable, and a warning.

    Args:
        name: Of the variable, for the warning.
        real: Values of the recording, shape (M,).
        simulated: Values of the simulator's frames.
    """
    ordered = simulated.sort().values
    last = len(ordered) - 1
    low, high = (float(ordered[round(q * last)]) for q in (_OUTSIDE, 1 - _OUTSIDE))
    margin = _MARGIN * (high - low)
    outside = (real < low - margin) | (real > high + margin)
    share = float(outside.double().mean())
    if share <= _WORTH_A_WARNING:
        return outside, []
    return outside, [
        f"{100 * share:.1f} % of the recording's pixels lie beyond the simulator's range of "
        f"{name} ({low:.3g} to {high:.3g}); they are left out."
    ]


def worth_keeping(directions: Tensor, least: float, most: int) -> Tensor:
    """Return the columns (M, J) of the largest root mean square, at least `least` and `most`."""
    size = directions.square().mean(0).sqrt()
    order = size.argsort(descending=True)[:most]
    return directions[:, order[size[order] > least]]
