"""What a training says of itself: what it leaves out, verdict, warnings, text of the report."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Literal, NamedTuple, TypeVar

import numpy as np
import torch

from tofcorr.estimation.uncertainty import PRIOR_SIGMA, Direction
from tofcorr.fit.result import Fit
from tofcorr.geometry.camera import FrameNames
from tofcorr.plausibility.checks.garbage import FAR_OFF
from tofcorr.plausibility.finding import in_words
from tofcorr.plausibility.inspection import Inspection
from tofcorr.training.options import TrainingOptions
from tofcorr.training.support import Support, hardly_tilted, shortcomings

Training = TypeVar("Training", bound=TrainingOptions)

# Fewest frames left to fit on: as `pixels.split` asks for, and one more.
_FEWEST_FRAMES = 4


def against_garbage(options: Training, inspection: Inspection) -> Training:
    """Return the options with robust weights and the largest plane, where garbage spoils a fit.

    Only where the options leave the choice of pixels to the recording.
    """
    chosen = options.mask != "recording" or options.outlier_window_mm is not None
    if not inspection.garbage_bends or chosen or options.weights.robust != "none":
        return options
    weights = options.weights.model_copy(update={"robust": "cauchy"})
    return options.model_copy(
        update={"mask": "ransac", "mask_tolerance_mm": 1e3 * FAR_OFF, "weights": weights}
    )


def frames_left_out(inspection: Inspection, training: Iterable[np.ndarray]) -> tuple[int, ...]:
    """Return the frames that disagree with all others; none where too few would be left.

    Args:
        inspection: What was odd about the recordings.
        training: Global numbers of the frames to fit, an array a fit.
    """
    frames = tuple(inspection.outlying)
    enough = all((~np.isin(own, frames)).sum() >= _FEWEST_FRAMES for own in training)
    return frames if enough else ()


def left_out_words(frames: Sequence[int]) -> list[str]:
    """Return one sentence about frames left out; none if there is none."""
    if not frames:
        return []
    verb = "is" if len(frames) == 1 else "are"
    return [
        f"{in_words(tuple(frames)).capitalize()} {verb} left out of all fits and of the errors, as "
        "in a training: poses, planes or images disagree with all others."
    ]


def left_out_mapping(frames: Iterable[int], inspection: Inspection) -> list[dict[str, Any]]:
    """Return frames left out and by how much they disagree, the worst first: plain values."""
    chosen = set(frames)
    return [
        {"frame": frame, "off_mm": 1e3 * off}
        for frame, off in inspection.outlying.items()
        if frame in chosen
    ]


class Evidence(NamedTuple):
    """What is known of a fitted model.

    Attributes:
        fit: The fitted model.
        support: What the fitted frames cover.
        inspection: What was odd about the recordings.
        held_out: RMS error of held-out frames, millimetres; None: no frame was held out.
        fitted: The same of the fitted frames.
        bare: Of held-out frames with the hand-eye transform alone, millimetres.
        noise: Noise of a pixel, millimetres; NaN: unknown.
        noise_rms: Its root mean square over all pixels, millimetres; NaN: unknown.
    """

    fit: Fit
    support: Support
    inspection: Inspection
    held_out: float | None
    fitted: float
    bare: float | None
    noise: float
    noise_rms: float

    def measured(self) -> str:
        """Return the held-out error beside what it is compared with."""
        text = f"Held-out frames are off by {self.held_out:.1f} mm RMS"
        compared = [] if self.bare is None else [f"{self.bare:.1f} mm with the hand-eye alone"]
        if math.isfinite(self.noise):
            compared.append(f"{self.noise:.1f} mm noise of a pixel")
        return f"{text} ({', '.join(compared)})" if compared else text


Rule = Callable[[Evidence], str | None]
"""Looks at one thing; gives the reason against a run in one sentence, None where it is fine."""


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


# Number of training images below which the standard errors are themselves rough: from n images
# they are known to about 1 / sqrt(2 (n - 1)), a quarter for ten.
_FEW_IMAGES = 10
# Weak directions named, the weakest first; all are in report.json. Chosen.
_MOST_WEAK = 3


def warnings(
    fit: Fit, errors: Mapping[str, Any], support: Support, noise_mm: float, *, robot_moves: bool
) -> list[str]:
    """Return what a user must know before trusting the result, one sentence each.

    The gravest come first; what has one cause is said once.

    Args:
        fit: The fitted model.
        errors: The `error_mm` of the report.
        support: What the frames fitted cover.
        noise_mm: Noise of the pixels, root mean square; NaN: unknown.
        robot_moves: Whether a robot moved the camera.
    """
    found: list[str] = []
    if not fit.solution.converged:
        found.append(fit.solution.message)
    found += _overfitting_words(errors)
    found += [] if fit.misfit is None else [fit.misfit.in_words()]
    found += filter(None, [beyond_noise(errors["after"]["test"]["rms"], noise_mm)])
    found += _undetermined_words(fit)
    found += shortcomings(
        support,
        moves=fit.solution.parameters.hand_eye_is_free,
        with_intensity=fit.model.error.needs_amplitude(),
    )
    if fit.moments.num_images < _FEW_IMAGES:
        found.append(
            f"Only {fit.moments.num_images} images were fitted; standard errors are rough below "
            f"{_FEW_IMAGES}."
        )
    found += _weak(fit)
    found += _uncertain_curves(fit)
    if fit.residual is not None:
        found.append(fit.residual.in_words())
    if not robot_moves:
        found.append("No robot pose changes: the hand-eye transform is held at the identity.")
    return found


def _undetermined_words(fit: Fit) -> list[str]:
    """Return one sentence about all directions that the images do not determine."""
    words = [
        direction.in_words()
        for direction in fit.observability.undetermined
        if not _is_of_curves(direction, fit)
    ]
    if not words:
        return []
    return [
        f"The images do not determine {'; '.join(words)}: a prior of {1e3 * PRIOR_SIGMA:g} mm and "
        f"{1e3 * PRIOR_SIGMA:g} mrad around the starting guess is used instead."
    ]


def _weak(fit: Fit) -> list[str]:
    """Return one sentence about all directions that are determined, but weakly."""
    weak = [
        direction
        for direction in fit.observability.directions
        if _is_weak(direction)
        and not direction.is_undetermined
        and not _is_of_curves(direction, fit)
    ]
    words = [
        f"{1e3 * direction.sigma:.1f} of {direction.in_words()}" for direction in weak[:_MOST_WEAK]
    ]
    if not words:
        return []
    more = f"; and {len(weak) - len(words)} more" if len(weak) > len(words) else ""
    above = f"Standard errors above {1e3 * WEAK:g} mm (or mrad)"
    return [f"{above}: {'; '.join(words)}{more}."]


def _is_weak(direction: Direction) -> bool:
    return direction.sigma > WEAK


def _is_of_curves(direction: Direction, fit: Fit) -> bool:
    """Whether a direction concerns coefficients of penalised curves, and their constant, alone."""
    terms = [term for term, _ in fit.model.error.penalised()]
    return set(direction.shares) <= {"c0", *(symbol for term in terms for symbol in term.symbols)}


def _uncertain_curves(fit: Fit) -> list[str]:
    """Return how uncertain the curves are where no pixel was."""
    sigmas = [
        direction.sigma
        for direction in fit.observability.directions
        if _is_weak(direction) and len(direction.shares) > 1 and _is_of_curves(direction, fit)
    ]
    if not sigmas:
        return []
    number = "1 direction" if len(sigmas) == 1 else f"{len(sigmas)} directions"
    verb = "is" if len(sigmas) == 1 else "are"
    return [
        f"{number} of the curves {verb} set by the smoothing penalty, not by data, "
        f"with a standard deviation of up to {1e3 * max(sigmas):.0f} mm: the recording does not "
        "hold those combinations of distance and amplitude."
    ]


def _overfitting_words(errors: Mapping[str, Any]) -> list[str]:
    after = errors["after"]
    train, test, bare = after["train"]["rms"], after["test"]["rms"], errors["hand_eye_only"]["test"]
    if test is None:
        return ["No frame was held out: the errors given are those of the fit itself."]
    if test > OVERFITTED * train:
        return [
            f"The held-out error ({test:.1f} mm RMS) is much larger than that of the fit "
            f"({train:.1f} mm): record more views, or choose a smaller model."
        ]
    if bare["rms"] is None or test <= bare["rms"]:
        return []
    compared = f"({test:.1f} mm RMS) than the hand-eye alone ({bare['rms']:.1f} mm)"
    if test > WORSE * bare["rms"]:
        return [f"The depth correction makes held-out frames worse {compared}: do not use it."]
    return [
        f"The depth correction leaves no less on held-out frames {compared}: this camera has "
        "hardly an error that the model describes, and the hand-eye transform is enough."
    ]


Verdict = Literal["good", "usable", "do not use"]
DO_NOT_USE: Verdict = "do not use"


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
    evidence = Evidence(
        fit=fit,
        support=support,
        inspection=inspection,
        held_out=after["test"]["rms"],
        fitted=after["train"]["rms"] or 0.0,
        bare=errors["hand_eye_only"]["test"]["rms"],
        noise=1e3 * inspection.look.sample.noise,
        noise_rms=1e3 * inspection.look.sample.noise_rms,
    )
    judged: tuple[tuple[Verdict, Sequence[Rule]], ...]
    judged = ((DO_NOT_USE, REFUSALS), ("usable", RESERVATIONS))
    for verdict, rules in judged:
        for rule in rules:
            reason = rule(evidence)
            if reason is not None:
                return verdict, reason
    return "good", f"{evidence.measured()}, and {_determined(fit)}."


def _determined(fit: Fit) -> str:
    """Return what is known to the accuracy of a good run; some coefficients may not be."""
    if all(one.sigma <= WEAK for one in fit.observability.directions):
        return "every direction is determined"
    return f"the hand-eye transform is determined to {1e3 * WEAK:g} mm and mrad"


# Warnings printed; the rest is in report.json. Chosen: more are not read.
_MOST_WARNINGS = 5


def report_text(report: Mapping[str, Any]) -> str:
    """Return errors, hand-eye translation, advice and warnings, a line each."""
    return "\n".join(
        [
            *_headline_lines(report),
            *_table(report),
            *_hand_eye(report),
            *_advice_lines(report),
            *_warning_lines(report),
            f"Verdict: {report['verdict']}. {report['reason']}",
        ]
    )


def _headline_lines(report: Mapping[str, Any]) -> list[str]:
    return [report["headline"]] if report["headline"] else []


def _warning_lines(report: Mapping[str, Any]) -> list[str]:
    """Return the first warnings, a line each, and how many more report.json holds.

    One that is the reason of the verdict is said there.
    """
    found = [warning for warning in report["warnings"] if warning != report["reason"]]
    shown = [f"Warning: {warning}" for warning in found[:_MOST_WARNINGS]]
    more = len(found) - len(shown)
    return [*shown, f"{more} more warnings are in report.json."] if more else shown


def _table(report: Mapping[str, Any]) -> list[str]:
    """Return the errors as aligned columns, millimetres."""
    lines = [f"{report['model']:<16}{'train':>18}{'held out':>20}"]
    lines += [f"{'mm':<16}{'mean abs':>9}{'RMS':>9}{'mean abs':>11}{'RMS':>9}"]
    for stage, halves in report["error_mm"].items():
        cells = [halves[half][kind] for half in ("train", "test") for kind in ("mean_abs", "rms")]
        text = ["-" if cell is None else f"{cell:.2f}" for cell in cells]
        name = stage.replace("hand_eye", "hand-eye").replace("_", " ")
        lines.append(f"{name:<16}{text[0]:>9}{text[1]:>9}{text[2]:>11}{text[3]:>9}")
    return lines


def _hand_eye(report: Mapping[str, Any]) -> list[str]:
    hand_eye = report["hand_eye"]
    if not hand_eye["estimated"]:
        return []
    lines = [
        hand_eye_text(hand_eye),
        noise_shift_text(hand_eye),
        assumptions_text(report["assumptions"]),
    ]
    return [*filter(None, lines)]


def _advice_lines(report: Mapping[str, Any]) -> list[str]:
    """Return which poses to add, a line each; nothing if there is no advice."""
    advice = report["advice"]
    if advice is None:
        return []
    return [
        f"The largest standard error is {advice['worst_sigma_mm_or_mrad']:.2f} mm (or mrad), of "
        f"{report['observability']['weakest'][0]['direction']}. To lower it, add:",
        *(
            f"  {pose['target']:<14}{pose['distance_m']:6.2f} m, tilted {pose['tilt_deg']:.0f} "
            f"deg, rolled by {pose['roll_by_deg']:+.0f}: then {pose['worst_sigma_mm_or_mrad']:.2f}"
            for pose in advice["poses"]
        ),
    ]


def hand_eye_text(hand_eye: Mapping[str, Any]) -> str:
    """Return where the camera sits, with standard errors, in one line.

    Args:
        hand_eye: What `hand_eye_summary` gave.
    """
    frames = hand_eye["frames"]
    named = frames != FrameNames().to_mapping()
    where = f" of {frames['camera']} in {frames['tool']}" if named else ""
    translation = [1e3 * row[3] for row in hand_eye["tool_from_camera"][:3]]
    pairs = zip(translation, hand_eye["translation_se_mm"], strict=True)
    return f"hand-eye translation{where}, mm: " + "  ".join(f"{t:.2f} ± {s:.2f}" for t, s in pairs)


def noise_shift_text(hand_eye: Mapping[str, Any]) -> str | None:
    """Return in one line how far the noise of the distances moved the estimate; None: unknown.

    Args:
        hand_eye: What `hand_eye_summary` gave.
    """
    shift = hand_eye["noise_shift"]
    if shift is None:
        return None
    done = "taken off" if shift["removed"] else "not taken off; the standard errors contain it"
    millimetres = "  ".join(f"{t:+z.2f}" for t in shift["translation_mm"])
    return f"  moved by the noise of the distances, mm: {millimetres} ({done})"


def assumptions_text(assumptions: Sequence[Mapping[str, Any]]) -> str | None:
    """Return in one line what errors of intrinsics and planes would do; None: nothing to say.

    Args:
        assumptions: What `assumptions_summary` gave.
    """
    moved = [
        f"{math.hypot(*one['translation_mm']):.1f} mm for {one['error']}" for one in assumptions
    ]
    return f"  what ± leaves out: {', '.join(moved)}" if moved else None
