"""The verdict of a run: good, usable, or do not use; and why, in one sentence."""

import math
from collections.abc import Callable, Mapping
from typing import Any, Literal, NamedTuple

import torch

from tofcorr.fit.result import Fit
from tofcorr.plausibility.inspection import Inspection
from tofcorr.training.support import Support, hardly_tilted

Verdict = Literal["good", "usable", "do not use"]
DO_NOT_USE: Verdict = "do not use"

# Held-out RMS error over that of the hand-eye alone from which the correction makes things worse.
# Chosen: a twentieth is within the chance of a split.
WORSE = 1.05
# The same from which it gains nothing, if the error is also above so many times the noise.
# Chosen: a camera without errors reaches the noise with the hand-eye alone.
_NO_GAIN, _ABOVE_NOISE = 0.95, 3.0
# Held-out RMS error that no application bears, millimetres, and in times the noise. Chosen: the raw
# error of most cameras.
_HOPELESS_MM, _HOPELESS_TIMES = 30.0, 8.0
# Error of the fit relative to the noise of a pixel below which it has collapsed. Chosen: no model
# can foresee noise.
_BELOW_NOISE = 0.1
# Slope of corrected over measured depth below which a fit with walls of unknown place has
# shortened its distances, no unit. Chosen: no camera's error grows by a third of the distance.
_SHORTENED = 0.7
# Held-out over fitted RMS error up to which a run is good. Chosen, as in `warning_texts`.
_OVERFITTED = 1.5
# Largest standard error of the hand-eye of a good run, metres or radians: 5 mm or 5 mrad. Chosen,
# as in `warning_texts`.
_WEAK = 5e-3
# Held-out error beyond the noise of the pixels that a good run may have, millimetres, and in times
# that noise. Chosen: poses of an ordinary robot scatter less, and edges raise the noise by a tenth.
_BEYOND_MM, _BEYOND_TIMES = 1.5, 0.6


class _Evidence(NamedTuple):
    fit: Fit
    support: Support
    inspection: Inspection
    held_out: float | None
    fitted: float
    bare: float | None
    noise: float
    noise_rms: float


def judge(
    fit: Fit, errors: Mapping[str, Any], support: Support, inspection: Inspection
) -> tuple[Verdict, str]:
    """Return the verdict and its reason.

    Args:
        fit: The fitted model.
        errors: The `error_mm` of the report.
        support: What the fitted frames cover.
        inspection: What was odd about the recordings; its noise of a pixel is the floor.
    """
    after = errors["after"]
    evidence = _Evidence(
        fit=fit,
        support=support,
        inspection=inspection,
        held_out=after["test"]["rms"],
        fitted=after["train"]["rms"] or 0.0,
        bare=errors["hand_eye_only"]["test"]["rms"],
        noise=1e3 * inspection.look.sample.noise,
        noise_rms=1e3 * inspection.look.sample.noise_rms,
    )
    judged: tuple[tuple[Verdict, tuple[_Rule, ...]], ...]
    judged = ((DO_NOT_USE, _REFUSALS), ("usable", _RESERVATIONS))
    for verdict, rules in judged:
        for rule in rules:
            reason = rule(evidence)
            if reason is not None:
                return verdict, reason
    return "good", f"{_measured(evidence)}, and {_determined(fit)}."


def _determined(fit: Fit) -> str:
    """Return what is known to the accuracy of a good run; some coefficients may not be."""
    if all(one.sigma <= _WEAK for one in fit.observability.directions):
        return "every direction is determined"
    return f"the hand-eye transform is determined to {1e3 * _WEAK:g} mm and mrad"


def _measured(at: _Evidence) -> str:
    """Return the held-out error beside what it is compared with."""
    text = f"Held-out frames are off by {at.held_out:.1f} mm RMS"
    compared = [] if at.bare is None else [f"{at.bare:.1f} mm with the hand-eye alone"]
    if math.isfinite(at.noise):
        compared.append(f"{at.noise:.1f} mm noise of a pixel")
    return f"{text} ({', '.join(compared)})" if compared else text


def _impossible(at: _Evidence) -> str | None:
    found = at.inspection.impossible
    return found[0].sentence if found else None


def _broken_off(at: _Evidence) -> str | None:
    if at.fit.solution.stopped != "not_finite":
        return None
    return (
        "The loss became NaN or infinite, so the parameters are those of the last point before "
        "that, and no fit: choose a smaller model, and see `tofcorr inspect`."
    )


def _worse(at: _Evidence) -> str | None:
    if at.held_out is None or at.bare is None or at.held_out <= WORSE * at.bare:
        return None
    return f"{_measured(at)}: the depth correction makes them worse."


def _no_gain(at: _Evidence) -> str | None:
    if at.held_out is None or at.bare is None or not math.isfinite(at.noise):
        return None
    if at.held_out <= max(_NO_GAIN * at.bare, _ABOVE_NOISE * at.noise):
        return None
    return f"{_measured(at)}: the correction gains nothing, so poses or planes are wrong."


def _spoilt(at: _Evidence) -> str | None:
    found = [one for one in at.inspection.findings if one.spoils]
    return found[0].sentence if found else None


def _collapsed(at: _Evidence) -> str | None:
    if not math.isfinite(at.noise) or at.fitted >= _BELOW_NOISE * at.noise:
        return None
    return (
        f"The fit leaves {at.fitted:.2g} mm where one pixel has {at.noise:.1f} mm of noise: too "
        "few different frames, so that the model could take every point to the camera."
    )


def _shortened(at: _Evidence) -> str | None:
    """Say that the fit had shorter distances, whose noise is smaller, and nearer walls."""
    gain = at.fit.gain
    if at.fit.walls is None or not gain < _SHORTENED:
        return None
    return (
        f"Where 1 m is measured, the fit leaves {gain:.2f} m: from few poses, or at one distance, "
        "errors that grow with the distance cannot be told from a nearer wall. Record poses nearer "
        "and farther, or measure the wall's plane."
    )


def _hopeless(at: _Evidence) -> str | None:
    error = at.fitted if at.held_out is None else at.held_out
    noise = at.noise if math.isfinite(at.noise) else 0.0
    if error <= max(_HOPELESS_MM, _HOPELESS_TIMES * noise):
        return None
    return f"Frames are off by {error:.0f} mm RMS after the fit: the model does not describe them."


def _doubtful(at: _Evidence) -> str | None:
    return at.inspection.headline


def _nothing_held_out(at: _Evidence) -> str | None:
    if at.held_out is not None:
        return None
    return "No frame was held out: the errors given are those of the fit itself."


def _unfinished(at: _Evidence) -> str | None:
    return None if at.fit.solution.converged else at.fit.solution.message


def _overfitted(at: _Evidence) -> str | None:
    if at.held_out is None or at.held_out <= _OVERFITTED * at.fitted:
        return None
    return f"{_measured(at)}, much more than the {at.fitted:.1f} mm of the fit itself."


def _undetermined(at: _Evidence) -> str | None:
    if not at.fit.solution.parameters.hand_eye_is_free:
        return None
    weak = [
        one
        for one in at.fit.observability.directions
        if one.is_undetermined or (one.sigma > _WEAK and _is_of_hand_eye(one.shares))
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


def _misfit(at: _Evidence) -> str | None:
    found = at.fit.misfit
    small = found is None or max(found.shift, found.turn) <= _WEAK
    return None if found is None or small else found.in_words()


def _uncertain(at: _Evidence) -> str | None:
    if not at.fit.solution.parameters.hand_eye_is_free:
        return None
    covariance = at.fit.hand_eye_covariance
    blocks = covariance[:3, :3], covariance[3:, 3:]
    shift, turn = (float(torch.linalg.eigvalsh(one)[-1].clamp(min=0).sqrt()) for one in blocks)
    if max(shift, turn) <= _WEAK:
        return None
    return (
        f"The hand-eye transform is known to {1e3 * shift:.1f} mm and {1e3 * turn:.1f} mrad only, "
        "along its worst axes: record more tilts and distances."
    )


def _hardly_tilted(at: _Evidence) -> str | None:
    free = at.fit.solution.parameters.hand_eye_is_free
    return hardly_tilted(at.support) if free else None


def _beyond_noise(at: _Evidence) -> str | None:
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


_Rule = Callable[[_Evidence], str | None]
_REFUSALS: tuple[_Rule, ...] = (
    _impossible,
    _broken_off,
    _spoilt,
    _shortened,
    _collapsed,
    _worse,
    _no_gain,
    _hopeless,
)
_RESERVATIONS: tuple[_Rule, ...] = (
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
