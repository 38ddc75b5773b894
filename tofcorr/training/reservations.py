"""Reasons why a usable run is not good; each rule looks at one, in one sentence."""

import math
from collections.abc import Mapping

import torch

from tofcorr.training.evidence import Evidence, Rule
from tofcorr.training.support import hardly_tilted

OVERFITTED = 1.5
"""Held-out over fitted RMS error, no unit, above which a model is too large, and no run is good.
Chosen."""
WEAK = 5e-3
"""Largest standard error of the hand-eye of a good run, metres or radians: 5 mm or 5 mrad; above it
a determined direction is weak. Chosen: the size of the errors that a calibration is to remove."""
# Held-out error beyond the noise of the pixels that a good run may have, millimetres, and in times
# that noise. Chosen: poses of an ordinary robot scatter less, and edges raise the noise by a tenth.
_BEYOND_MM, _BEYOND_TIMES = 1.5, 0.6


def _doubtful(at: Evidence) -> str | None:
    return at.inspection.headline


def _misfit(at: Evidence) -> str | None:
    found = at.fit.misfit
    small = found is None or max(found.shift, found.turn) <= WEAK
    return None if found is None or small else found.in_words()


def _nothing_held_out(at: Evidence) -> str | None:
    if at.held_out is not None:
        return None
    return "No frame was held out: the errors given are those of the fit itself."


def _unfinished(at: Evidence) -> str | None:
    return None if at.fit.solution.converged else at.fit.solution.message


def _overfitted(at: Evidence) -> str | None:
    if at.held_out is None or at.held_out <= OVERFITTED * at.fitted:
        return None
    return f"{at.measured()}, much more than the {at.fitted:.1f} mm of the fit itself."


def _undetermined(at: Evidence) -> str | None:
    if not at.fit.solution.parameters.hand_eye_is_free:
        return None
    weak = [
        one
        for one in at.fit.observability.directions
        if one.is_undetermined or (one.sigma > WEAK and _is_of_hand_eye(one.shares))
    ]
    if not weak:
        return None
    worst, advice = weak[0], "record more tilts and distances"
    if worst.is_undetermined:
        return f"The images do not determine {worst.in_words()}: {advice}."
    return (
        f"The standard error of {worst.in_words()} is {1e3 * worst.sigma:.0f} mm (or mrad): "
        f"{advice}."
    )


def _uncertain(at: Evidence) -> str | None:
    if not at.fit.solution.parameters.hand_eye_is_free:
        return None
    covariance = at.fit.hand_eye_covariance
    blocks = covariance[:3, :3], covariance[3:, 3:]
    shift, turn = (float(torch.linalg.eigvalsh(one)[-1].clamp(min=0).sqrt()) for one in blocks)
    if max(shift, turn) <= WEAK:
        return None
    return (
        f"The hand-eye transform is known to {1e3 * shift:.1f} mm and {1e3 * turn:.1f} mrad only, "
        "along its worst axes: record more tilts and distances."
    )


def _hardly_tilted(at: Evidence) -> str | None:
    free = at.fit.solution.parameters.hand_eye_is_free
    return hardly_tilted(at.support) if free else None


def _beyond_noise(at: Evidence) -> str | None:
    return beyond_noise(at.held_out, at.noise_rms)


def beyond_noise(held_out: float | None, noise: float) -> str | None:
    """Return one sentence about an error that neither the model nor noise explains; None: small.

    Args:
        held_out: RMS error of held-out frames, millimetres; None: no frame was held out.
        noise: Noise of their pixels, root mean square, millimetres; NaN: unknown.
    """
    if held_out is None or not held_out > noise:
        return None
    beyond = math.sqrt(held_out**2 - noise**2)
    if beyond <= max(_BEYOND_MM, _BEYOND_TIMES * noise):
        return None
    return (
        f"Held-out frames are off by {beyond:.1f} mm beyond the noise of their pixels: poses or "
        "planes scatter so much, or the camera has an error that this model lacks, which may move "
        "the hand-eye transform by more than its standard errors; `tofcorr diagnose` tells which."
    )


def _is_of_hand_eye(shares: Mapping[str, float]) -> bool:
    return any(symbol.startswith(("t_", "w_")) for symbol in shares)


RESERVATIONS: tuple[Rule, ...] = (
    _doubtful,
    _misfit,
    _nothing_held_out,
    _unfinished,
    _overfitted,
    _undetermined,
    _uncertain,
    _hardly_tilted,
    _beyond_noise,
)
"""The rules, the weightiest first."""
