"""Reasons not to use a run; each rule looks at one, in one sentence."""

import math

from tofcorr.training.evidence import Evidence, Rule

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


def _impossible(at: Evidence) -> str | None:
    found = at.inspection.impossible
    return found[0].sentence if found else None


def _broken_off(at: Evidence) -> str | None:
    if at.fit.solution.stopped != "not_finite":
        return None
    return (
        "The loss became NaN or infinite, so the parameters are those of the last point before "
        "that, and no fit: choose a smaller model, and see `tofcorr inspect`."
    )


def _spoilt(at: Evidence) -> str | None:
    found = [one for one in at.inspection.findings if one.spoils]
    return found[0].sentence if found else None


def _shortened(at: Evidence) -> str | None:
    """Say that the fit had shorter distances, whose noise is smaller, and nearer walls."""
    gain = at.fit.gain
    if at.fit.walls is None or not gain < _SHORTENED:
        return None
    return (
        f"Where 1 m is measured, the fit leaves {gain:.2f} m: from few poses, or at one distance, "
        "errors that grow with the distance cannot be told from a nearer wall. Record poses nearer "
        "and farther, or measure the wall's plane."
    )


def _collapsed(at: Evidence) -> str | None:
    if not math.isfinite(at.noise) or at.fitted >= _BELOW_NOISE * at.noise:
        return None
    return (
        f"The fit leaves {at.fitted:.2g} mm where one pixel has {at.noise:.1f} mm of noise: too "
        "few different frames, so that the model could take every point to the camera."
    )


def _worse(at: Evidence) -> str | None:
    if at.held_out is None or at.bare is None or at.held_out <= WORSE * at.bare:
        return None
    return f"{at.measured()}: the depth correction makes them worse."


def _no_gain(at: Evidence) -> str | None:
    if at.held_out is None or at.bare is None or not math.isfinite(at.noise):
        return None
    if at.held_out <= max(_NO_GAIN * at.bare, _ABOVE_NOISE * at.noise):
        return None
    return f"{at.measured()}: the correction gains nothing, so poses or planes are wrong."


def _hopeless(at: Evidence) -> str | None:
    error = at.fitted if at.held_out is None else at.held_out
    noise = at.noise if math.isfinite(at.noise) else 0.0
    if error <= max(_HOPELESS_MM, _HOPELESS_TIMES * noise):
        return None
    return f"Frames are off by {error:.0f} mm RMS after the fit: the model does not describe them."


REFUSALS: tuple[Rule, ...] = (
    _impossible,
    _broken_off,
    _spoilt,
    _shortened,
    _collapsed,
    _worse,
    _no_gain,
    _hopeless,
)
"""The rules, the surest first."""
