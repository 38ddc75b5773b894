"""What a simulator that saw other poses covers of a recording."""

from torch import Tensor

from tofcorr.simulation.effects.inputs import EffectInputs

# Share of a variable's values that its range leaves out at each end, against single gross errors.
# Chosen.
_OUTSIDE = 0.001
# A range counts as covered this far beyond its ends, as a share of it. Chosen: a low polynomial
# hardly leaves its course there.
_MARGIN = 0.05
# Amplitudes whose scales differ by less than this factor have the same unit. Chosen: the median of
# other poses and of targets of several brightnesses varies almost so much.
_SAME_UNIT = 1.5
# Shares of pixels beyond a range below this are not worth a warning. Chosen.
_WORTH_A_WARNING = 0.001


def amplitude_scale(real: EffectInputs, targets: Tensor, simulated: EffectInputs) -> float:
    """Return the recording's unit of amplitude over the simulator's; 1 if they are alike.

    An amplitude falls with the square of the distance and the cosine of the incidence, and grows
    with the integration time; what remains is compared by its median over like targets.

    Args:
        real: Of the recording.
        targets: Whether a pixel's target was simulated as well, shape (M,), bool.
        simulated: Of the simulator's frames.
    """
    if real.amplitude is None or simulated.amplitude is None or not bool(targets.any()):
        return 1.0
    timed = real.facts.integration_time is not None
    timed = timed and simulated.facts.integration_time is not None
    own = _brightness(real, timed=timed)[targets].median()
    ratio = float(own / _brightness(simulated, timed=timed).median())
    return ratio if ratio > _SAME_UNIT or 0 < ratio < 1 / _SAME_UNIT else 1.0


def _brightness(inputs: EffectInputs, *, timed: bool) -> Tensor:
    cosine = inputs.incidence_cosine.clamp(min=1e-3)
    brightness = inputs.known_amplitude * inputs.radial_distance**2 / cosine
    times = inputs.facts.integration_time
    return brightness / inputs.of_frame(times) if timed and times is not None else brightness


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
