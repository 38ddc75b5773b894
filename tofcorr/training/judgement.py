"""What a training says of itself: what it leaves out, verdict, warnings, text of the report."""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, Literal, NamedTuple, TypeVar

import numpy as np
import torch

from tofcorr.estimation.uncertainty import PRIOR_SIGMA, Direction
from tofcorr.fit.result import Fit
from tofcorr.geometry.camera import FrameNames
from tofcorr.plausibility.checks.geometry import FAR_OFF
from tofcorr.plausibility.finding import Inspection, in_words
from tofcorr.training.options import TrainingOptions
from tofcorr.training.support import Support, hardly_tilted, shortcomings

Training = TypeVar("Training", bound=TrainingOptions)
Verdict = Literal["good", "usable", "do not use"]
DO_NOT_USE: Verdict = "do not use"


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


def frames_left_out(
    inspection: Inspection, training: Iterable[np.ndarray], fewest: int = 4
) -> tuple[int, ...]:
    """Return the frames that disagree with all others; none where too few would be left.

    Args:
        inspection: What was odd about the recordings.
        training: Global numbers of the frames to fit, an array a fit.
        fewest: Frames left to fit on: as `split_frames` asks for, and one more.
    """
    frames = tuple(inspection.outlying)
    enough = all((~np.isin(own, frames)).sum() >= fewest for own in training)
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
    chosen, outlying = set(frames), inspection.outlying.items()
    return [{"frame": frame, "off_mm": 1e3 * off} for frame, off in outlying if frame in chosen]


class Limits(NamedTuple):
    """What a verdict and the warnings compare with; errors are root mean squares.

    Attributes:
        weak: Largest standard error of the hand-eye of a good run, metres or radians: the size of
            the errors that a calibration is to remove. Above it a direction is weak.
        overfitted: Held-out over fitted error above which a model is too large.
        worse: Held-out error over that of the hand-eye alone from which the correction makes
            things worse: a twentieth is within the chance of a split.
        no_gain: The same from which it gains nothing, if the error is also above `above_noise`
            times the noise: a camera without errors reaches the noise with the hand-eye alone.
        above_noise: See `no_gain`.
        hopeless_mm: Error that no application bears, millimetres: the raw error of most cameras.
        hopeless_times: The same, in times the noise.
        below_noise: Error of the fit over the noise of a pixel below which it has collapsed: no
            model can foresee noise.
        shortened: Slope of corrected over measured depth below which a fit with unknown walls has
            shortened its distances: no camera's error grows by a third of the distance.
        beyond_mm: Held-out error beyond the noise that a good run may have, millimetres: poses of
            an ordinary robot scatter less.
        beyond_times: The same, in times the noise: edges raise it by a tenth.
        few_images: Training images below which standard errors are themselves rough: from n images
            they are known to about 1 / sqrt(2 (n - 1)), a quarter for ten.
    """

    weak: float = 5e-3
    overfitted: float = 1.5
    worse: float = 1.05
    no_gain: float = 0.95
    above_noise: float = 3.0
    hopeless_mm: float = 30.0
    hopeless_times: float = 8.0
    below_noise: float = 0.1
    shortened: float = 0.7
    beyond_mm: float = 1.5
    beyond_times: float = 0.6
    few_images: int = 10


def judge(
    fit: Fit,
    errors: Mapping[str, Any],
    support: Support,
    inspection: Inspection,
    limits: Limits = Limits(),  # noqa: B008 - a tuple of numbers
) -> tuple[Verdict, str]:
    """Return the verdict and its reason.

    Args:
        fit: The fitted model.
        errors: The `error_mm` of the report.
        support: What the fitted frames cover.
        inspection: What was odd about the recordings; its noise of a pixel is the floor.
        limits: What errors are compared with.
    """
    noise, held_out = 1e3 * inspection.look.noise, errors["after"]["test"]["rms"]
    bare = errors["hand_eye_only"]["test"]["rms"]
    compared = [] if bare is None else [f"{bare:.1f} mm with the hand-eye alone"]
    compared += [f"{noise:.1f} mm noise of a pixel"] if math.isfinite(noise) else []
    measured = f"Held-out frames are off by {held_out or 0.0:.1f} mm RMS"
    measured += f" ({', '.join(compared)})" if compared else ""
    reason = next(_against_its_use(fit, inspection, limits), None) or next(
        _against_its_errors(errors, noise, measured, limits), None
    )
    if reason is not None:
        return DO_NOT_USE, reason
    reason = next(
        _reservations(
            fit, errors, support, inspection, measured, 1e3 * inspection.look.noise_rms, limits
        ),
        None,
    )
    if reason is not None:
        return "usable", reason
    if all(one.sigma <= limits.weak for one in fit.observability.directions):
        return "good", f"{measured}, and every direction is determined."
    known = f"the hand-eye transform is determined to {1e3 * limits.weak:g} mm and mrad"
    return "good", f"{measured}, and {known}."


def _against_its_use(fit: Fit, inspection: Inspection, limits: Limits) -> Iterator[str]:
    """Yield reasons of recording and fit not to use a run, the surest first."""
    yield from (one.sentence for one in inspection.impossible)
    if fit.solution.stopped == "not_finite":
        yield (
            "The loss became NaN or infinite, so the parameters are those of the last point before "
            "that, and no fit: choose a smaller model, and see `tofcorr inspect`."
        )
    yield from (one.sentence for one in inspection.findings if one.spoils)
    # Shorter distances have smaller noise, so that unknown walls move nearer.
    if fit.walls is not None and fit.gain < limits.shortened:
        yield (
            f"Where 1 m is measured, the fit leaves {fit.gain:.2f} m: from few poses, or at one "
            "distance, errors that grow with the distance cannot be told from a nearer wall. "
            "Record poses nearer and farther, or measure the wall's plane."
        )


def _against_its_errors(
    errors: Mapping[str, Any], noise: float, measured: str, limits: Limits
) -> Iterator[str]:
    """Yield reasons of its errors not to use a run; `noise` of a pixel, mm, NaN: unknown."""
    held_out, bare = (errors[stage]["test"]["rms"] for stage in ("after", "hand_eye_only"))
    fitted = errors["after"]["train"]["rms"] or 0.0
    if fitted < limits.below_noise * noise:
        yield (
            f"The fit leaves {fitted:.2g} mm where one pixel has {noise:.1f} mm of noise: too "
            "few different frames, so that the model could take every point to the camera."
        )
    if held_out is not None and bare is not None:
        if held_out > limits.worse * bare:
            yield f"{measured}: the depth correction makes them worse."
        if held_out > limits.no_gain * bare and held_out > limits.above_noise * noise:
            yield f"{measured}: the correction gains nothing, so poses or planes are wrong."
    error, floor = fitted if held_out is None else held_out, np.nan_to_num(noise)
    if error > max(limits.hopeless_mm, limits.hopeless_times * floor):
        yield (
            f"Frames are off by {error:.0f} mm RMS after the fit: the model does not describe them."
        )


def _reservations(
    fit: Fit,
    errors: Mapping[str, Any],
    support: Support,
    inspection: Inspection,
    measured: str,
    noise_rms: float,
    limits: Limits,
) -> Iterator[str]:
    """Yield reasons why a usable run is not good, the weightiest first."""
    held_out, fitted = (errors["after"][half]["rms"] for half in ("test", "train"))
    if inspection.headline is not None:
        yield inspection.headline
    if fit.misfit is not None and max(fit.misfit.shift, fit.misfit.turn) > limits.weak:
        yield fit.misfit.in_words()
    if held_out is None:
        yield _NOTHING_HELD_OUT
    if not fit.solution.converged:
        yield fit.solution.message
    if held_out is not None and held_out > limits.overfitted * (fitted or 0.0):
        yield f"{measured}, much more than the {fitted or 0.0:.1f} mm of the fit itself."
    if fit.solution.parameters.hand_eye_is_free:
        yield from _of_hand_eye(fit, limits)
        yield from filter(None, [hardly_tilted(support)])
    yield from filter(None, [beyond_noise(held_out, noise_rms, limits)])


_NOTHING_HELD_OUT = "No frame was held out: the errors given are those of the fit itself."


def _of_hand_eye(fit: Fit, limits: Limits) -> Iterator[str]:
    """Yield in what the hand-eye transform is uncertain."""
    for one in fit.observability.directions:
        if one.is_undetermined:
            yield (
                f"The images do not determine {one.in_words()}: record more tilts and distances."
            )
        elif one.sigma > limits.weak and any(name.startswith(("t_", "w_")) for name in one.shares):
            yield (
                f"The standard error of {one.in_words()} is {1e3 * one.sigma:.0f} mm (or mrad): "
                "record more tilts and distances."
            )
    covariance = fit.hand_eye_covariance
    blocks = covariance[:3, :3], covariance[3:, 3:]
    shift, turn = (float(torch.linalg.eigvalsh(one)[-1].clamp(min=0).sqrt()) for one in blocks)
    if max(shift, turn) > limits.weak:
        yield (
            f"The hand-eye transform is known to {1e3 * shift:.1f} mm and {1e3 * turn:.1f} mrad "
            "only, along its worst axes: record more tilts and distances."
        )


def beyond_noise(
    held_out: float | None,
    noise: float,
    limits: Limits = Limits(),  # noqa: B008 - a tuple of numbers
) -> str | None:
    """Return one sentence about an error that neither the model nor noise explains; None: small.

    Args:
        held_out: RMS error of held-out frames, millimetres; None: no frame was held out.
        noise: Noise of their pixels, root mean square, millimetres; NaN: unknown.
        limits: How large the error may be.
    """
    if held_out is None or not held_out > noise:
        return None
    beyond = math.sqrt(held_out**2 - noise**2)
    if beyond <= max(limits.beyond_mm, limits.beyond_times * noise):
        return None
    return (
        f"Held-out frames are off by {beyond:.1f} mm beyond the noise of their pixels: poses or "
        "planes scatter so much, or the camera has an error that this model lacks, which may move "
        "the hand-eye transform by more than its standard errors; `tofcorr diagnose` tells which."
    )


def warnings(
    fit: Fit,
    errors: Mapping[str, Any],
    support: Support,
    noise_mm: float,
    *,
    robot_moves: bool,
    limits: Limits = Limits(),  # noqa: B008 - a tuple of numbers
) -> list[str]:
    """Return what a user must know before trusting the result, one sentence each.

    The gravest come first; what has one cause is said once.

    Args:
        fit: The fitted model.
        errors: The `error_mm` of the report.
        support: What the frames fitted cover.
        noise_mm: Noise of the pixels, root mean square; NaN: unknown.
        robot_moves: Whether a robot moved the camera.
        limits: What errors are compared with.
    """
    few = (
        f"Only {fit.moments.num_images} images were fitted; standard errors are rough below "
        f"{limits.few_images}."
    )
    undetermined, *uncertain = _uncertain_directions(fit, limits)
    free = fit.solution.parameters.hand_eye_is_free
    found = [
        None if fit.solution.converged else fit.solution.message,
        _compared(errors, limits),
        None if fit.misfit is None else fit.misfit.in_words(),
        beyond_noise(errors["after"]["test"]["rms"], noise_mm, limits),
        undetermined,
        *shortcomings(support, moves=free, with_intensity=fit.model.error.needs_amplitude()),
        few if fit.moments.num_images < limits.few_images else None,
        *uncertain,
        None if fit.residual is None else fit.residual.in_words(),
        None
        if robot_moves
        else "No robot pose changes: the hand-eye transform is held at the identity.",
    ]
    return [sentence for sentence in found if sentence]


def _uncertain_directions(
    fit: Fit, limits: Limits, named: int = 3
) -> tuple[str | None, str | None, str | None]:
    """Return sentences: undetermined directions, weak ones, and those of curves without pixels.

    Args:
        fit: The fitted model.
        limits: From when on a direction is weak.
        named: Weak directions named, the weakest first; all are in report.json.
    """
    curves = {symbol for term, _ in fit.model.error.penalised() for symbol in term.symbols}

    def of_curves(one: Direction) -> bool:
        return set(one.shares) <= {"c0", *curves}

    directions = fit.observability.directions
    free = [one.in_words() for one in fit.observability.undetermined if not of_curves(one)]
    weak = [one for one in directions if one.sigma > limits.weak]
    sigmas = [one.sigma for one in weak if len(one.shares) > 1 and of_curves(one)]
    weak = [one for one in weak if not one.is_undetermined and not of_curves(one)]
    words = [f"{1e3 * one.sigma:.1f} of {one.in_words()}" for one in weak[:named]]
    more = f"; and {len(weak) - len(words)} more" if len(weak) > len(words) else ""
    number = "1 direction" if len(sigmas) == 1 else f"{len(sigmas)} directions"
    verb = "is" if len(sigmas) == 1 else "are"
    return (
        f"The images do not determine {'; '.join(free)}: a prior of {1e3 * PRIOR_SIGMA:g} mm and "
        f"{1e3 * PRIOR_SIGMA:g} mrad around the starting guess is used instead."
        if free
        else None,
        f"Standard errors above {1e3 * limits.weak:g} mm (or mrad): {'; '.join(words)}{more}."
        if words
        else None,
        f"{number} of the curves {verb} set by the smoothing penalty, not by data, "
        f"with a standard deviation of up to {1e3 * max(sigmas):.0f} mm: the recording does not "
        "hold those combinations of distance and amplitude."
        if sigmas
        else None,
    )


def _compared(errors: Mapping[str, Any], limits: Limits) -> str | None:
    """Compare the held-out error with that of the fit and of the hand-eye alone."""
    train, test = (errors["after"][half]["rms"] for half in ("train", "test"))
    bare = errors["hand_eye_only"]["test"]["rms"]
    if test is None:
        return _NOTHING_HELD_OUT
    if test > limits.overfitted * train:
        return (
            f"The held-out error ({test:.1f} mm RMS) is much larger than that of the fit "
            f"({train:.1f} mm): record more views, or choose a smaller model."
        )
    if bare is None or test <= bare:
        return None
    compared = f"({test:.1f} mm RMS) than the hand-eye alone ({bare:.1f} mm)"
    if test > limits.worse * bare:
        return f"The depth correction makes held-out frames worse {compared}: do not use it."
    return (
        f"The depth correction leaves no less on held-out frames {compared}: this camera has "
        "hardly an error that the model describes, and the hand-eye transform is enough."
    )


def report_text(report: Mapping[str, Any], most_warnings: int = 5) -> str:
    """Return errors, hand-eye translation, advice and warnings, a line each.

    Args:
        report: The content of report.json.
        most_warnings: Printed, without one that is the reason of the verdict; report.json has all.
    """
    lines = [report["headline"]] if report["headline"] else []
    # The errors as aligned columns, millimetres.
    lines.append(f"{report['model']:<16}{'train':>18}{'held out':>20}")
    lines.append(f"{'mm':<16}{'mean abs':>9}{'RMS':>9}{'mean abs':>11}{'RMS':>9}")
    for stage, halves in report["error_mm"].items():
        cells = [halves[half][kind] for half in ("train", "test") for kind in ("mean_abs", "rms")]
        text = ["-" if cell is None else f"{cell:.2f}" for cell in cells]
        name = stage.replace("hand_eye", "hand-eye").replace("_", " ")
        lines.append(f"{name:<16}{text[0]:>9}{text[1]:>9}{text[2]:>11}{text[3]:>9}")
    if report["hand_eye"]["estimated"]:
        lines += _hand_eye_lines(report)
    lines += _advice_lines(report)
    found = [warning for warning in report["warnings"] if warning != report["reason"]]
    lines += [f"Warning: {warning}" for warning in found[:most_warnings]]
    if len(found) > most_warnings:
        lines.append(f"{len(found) - most_warnings} more warnings are in report.json.")
    return "\n".join([*lines, f"Verdict: {report['verdict']}. {report['reason']}"])


def _hand_eye_lines(report: Mapping[str, Any]) -> Iterator[str]:
    """Yield where the camera sits, how far noise moved that, and what errors it leaves out."""
    hand_eye, shift = report["hand_eye"], report["hand_eye"]["noise_shift"]
    frames = hand_eye["frames"]
    named = frames != FrameNames().to_mapping()
    where = f" of {frames['camera']} in {frames['tool']}" if named else ""
    translation = [1e3 * row[3] for row in hand_eye["tool_from_camera"][:3]]
    pairs = zip(translation, hand_eye["translation_se_mm"], strict=True)
    yield f"hand-eye translation{where}, mm: " + "  ".join(f"{t:.2f} ± {s:.2f}" for t, s in pairs)
    if shift is not None:
        done = "taken off" if shift["removed"] else "not taken off; the standard errors contain it"
        millimetres = "  ".join(f"{t:+z.2f}" for t in shift["translation_mm"])
        yield f"  moved by the noise of the distances, mm: {millimetres} ({done})"
    moved = [
        f"{math.hypot(*one['translation_mm']):.1f} mm for {one['error']}"
        for one in report["assumptions"]
    ]
    if moved:
        yield f"  what ± leaves out: {', '.join(moved)}"


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
