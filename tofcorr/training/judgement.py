"""What a training says of itself: what it leaves out, verdict, warnings, text of the report."""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, Literal, TypeVar

import numpy as np

from tofcorr.estimation.uncertainty import PRIOR_SIGMA
from tofcorr.fit.problem import Fit
from tofcorr.geometry.camera import FrameNames
from tofcorr.pixels.sample import MaskOptions
from tofcorr.plausibility.finding import FAR_OFF, Inspection, in_words
from tofcorr.training.calibration import TrainingOptions
from tofcorr.training.support import Support, hardly_tilted, shortcomings, worst_sigma

Training = TypeVar("Training", bound=TrainingOptions)
Verdict = Literal["good", "usable", "do not use"]
DO_NOT_USE: Verdict = "do not use"

# What a verdict and the warnings compare with; errors are root mean squares.
#
# Largest standard error of the hand-eye of a good run, metres or radians: the size of the errors
# that a calibration is to remove. Above it a direction is weak.
_WEAK = 5e-3
# Held-out over fitted error above which a model is too large; and held-out error over that of the
# hand-eye alone from which the correction makes things worse, a twentieth being within the chance
# of a split, or gains nothing. A camera without errors reaches the noise with the hand-eye alone.
_OVERFITTED, _WORSE, _NO_GAIN = 1.5, 1.05, 0.95


def against_garbage(options: Training, inspection: Inspection) -> Training:
    """Return the options with robust weights and the largest plane, where garbage spoils a fit.

    Only where the options leave the choice of pixels to the recording.
    """
    masks = masks_against_garbage(options, inspection)
    if not masks or options.weights.robust != "none":
        return options
    weights = options.weights.model_copy(update={"robust": "cauchy"})
    return options.model_copy(update=masks | {"weights": weights})


def masks_against_garbage(options: MaskOptions, inspection: Inspection) -> dict[str, Any]:
    """Return the options of the masks that keep the largest plane; none where none are needed."""
    chosen = options.mask != "recording" or options.outlier_window_mm is not None
    if chosen or not inspection.garbage_bends:
        return {}
    return {"mask": "ransac", "mask_tolerance_mm": 1e3 * FAR_OFF}


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


def _rms(errors: Mapping[str, Any]) -> tuple[float, float, float]:
    """Return the RMS errors of the fit, held out, and held out with the hand-eye alone; or NaN."""
    stages = ("after", "train"), ("after", "test"), ("hand_eye_only", "test")
    found = [errors[stage][half]["rms"] for stage, half in stages]
    fitted, held_out, bare = (math.nan if one is None else one for one in found)
    return fitted, held_out, bare


def judge(
    fit: Fit, errors: Mapping[str, Any], support: Support, inspection: Inspection
) -> tuple[Verdict, str]:
    """Return the verdict and its reason: the first of what speaks against a run, or for it.

    Args:
        fit: The fitted model.
        errors: The `error_mm` of the report.
        support: What the fitted frames cover.
        inspection: What was odd about the recordings; its noise of a pixel is the floor.
    """
    look, (fitted, held_out, bare) = inspection.look, _rms(errors)
    noise = 1e3 * look.noise
    compared = [] if math.isnan(bare) else [f"{bare:.1f} mm with the hand-eye alone"]
    compared += [f"{noise:.1f} mm noise of a pixel"] if math.isfinite(noise) else []
    measured = f"Held-out frames are off by {np.nan_to_num(held_out):.1f} mm RMS"
    measured += f" ({', '.join(compared)})" if compared else ""
    error = fitted if math.isnan(held_out) else held_out
    against: list[tuple[bool, str]] = [
        *((True, one.sentence) for one in inspection.impossible),
        (
            fit.solution.stopped == "not_finite",
            "The loss became NaN or infinite, so the parameters are those of the last point before "
            "that, and no fit: choose a smaller model, and see `tofcorr inspect`.",
        ),
        *((True, one.sentence) for one in inspection.findings if one.spoils),
        (
            # Shorter distances have smaller noise, so that unknown walls move nearer. No camera's
            # error grows by a third of the distance.
            fit.walls is not None and fit.gain < 2 / 3,
            f"Where 1 m is measured, the fit leaves {fit.gain:.2f} m: from few poses, or at one "
            "distance, errors that grow with the distance cannot be told from a nearer wall. "
            "Record poses nearer and farther, or measure the wall's plane.",
        ),
        (
            # No model can foresee noise: below a tenth of it a fit has collapsed.
            np.nan_to_num(fitted) < noise / 10,
            f"The fit leaves {np.nan_to_num(fitted):.2g} mm where one pixel has {noise:.1f} mm of "
            "noise: too few different frames, so that the model could take every point to the "
            "camera.",
        ),
        (held_out > _WORSE * bare, f"{measured}: the depth correction makes them worse."),
        (
            held_out > _NO_GAIN * bare and held_out > 3 * noise,
            f"{measured}: the correction gains nothing, so poses or planes are wrong.",
        ),
        (
            # No application bears 30 mm, the raw error of most cameras, or eight times the noise.
            error > max(30, 8 * np.nan_to_num(noise)),
            f"Frames are off by {error:.0f} mm RMS after the fit: the model does not describe "
            "them.",
        ),
    ]
    free, lacking = fit.solution.parameters.hand_eye_is_free, fit.misfit
    frontal, beyond = hardly_tilted(support), beyond_noise(held_out, 1e3 * look.noise_rms)
    reservations: list[tuple[bool, str]] = [
        (inspection.headline is not None, inspection.headline or ""),
        *((max(one.size) > _WEAK, one.lacking()) for one in (lacking,) if one is not None),
        (math.isnan(held_out), _NOTHING_HELD_OUT),
        (not fit.solution.converged, fit.solution.message),
        (
            held_out > _OVERFITTED * np.nan_to_num(fitted),
            f"{measured}, much more than the {np.nan_to_num(fitted):.1f} mm of the fit itself.",
        ),
        *((free, sentence) for sentence in _of_hand_eye(fit)),
        (free and frontal is not None, frontal or ""),
        (beyond is not None, beyond or ""),
    ]
    for reason in (sentence for counts, sentence in against if counts):
        return DO_NOT_USE, reason
    for reason in (sentence for counts, sentence in reservations if counts):
        return "usable", reason
    if all(one.sigma <= _WEAK for one in fit.observability.directions):
        return "good", f"{measured}, and every direction is determined."
    known = f"the hand-eye transform is determined to {1e3 * _WEAK:g} mm and mrad"
    return "good", f"{measured}, and {known}."


_NOTHING_HELD_OUT = "No frame was held out: the errors given are those of the fit itself."


def _of_hand_eye(fit: Fit) -> Iterator[str]:
    """Yield in what the hand-eye transform is uncertain."""
    more = "record more tilts and distances."
    for one in fit.observability.directions:
        if one.is_undetermined:
            yield f"The images do not determine {one.in_words()}: {more}"
        elif one.sigma > _WEAK and any(name.startswith(("t_", "w_")) for name in one.shares):
            known = f"{1e3 * one.sigma:.0f} mm (or mrad)"
            yield f"The standard error of {one.in_words()} is {known}: {more}"
    covariance = fit.hand_eye_covariance
    shift, turn = (worst_sigma(covariance[axes, axes]) for axes in (slice(3), slice(3, 6)))
    if max(shift, turn) > _WEAK:
        yield (
            f"The hand-eye transform is known to {1e3 * shift:.1f} mm and {1e3 * turn:.1f} mrad "
            f"only, along its worst axes: {more}"
        )


def beyond_noise(held_out: float, noise: float) -> str | None:
    """Return one sentence about an error that neither the model nor noise explains; None: small.

    Poses of an ordinary robot scatter by less than 1.5 mm, and edges raise the noise by a tenth:
    what is beyond, as a root of the difference of squares, is then below 0.6 times the noise.

    Args:
        held_out: RMS error of held-out frames, millimetres; NaN: no frame was held out.
        noise: Noise of their pixels, root mean square, millimetres; NaN: unknown.
    """
    beyond = math.sqrt(max(held_out**2 - noise**2, 0.0))
    if not beyond > max(1.5, 0.6 * noise):
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
    undetermined, *uncertain = _uncertain_directions(fit)
    free, images = fit.solution.parameters.hand_eye_is_free, fit.moments.num_images
    # From n images a standard error is known to about 1 / sqrt(2 (n - 1)), a quarter for ten.
    few = f"Only {images} images were fitted; standard errors are rough below 10."
    found = [
        None if fit.solution.converged else fit.solution.message,
        _compared(*_rms(errors)),
        None if fit.misfit is None else fit.misfit.lacking(),
        beyond_noise(_rms(errors)[1], noise_mm),
        undetermined,
        *shortcomings(support, moves=free, with_intensity=fit.model.error.needs_amplitude()),
        few if images < 10 else None,
        *uncertain,
        fit.residual,
        None
        if robot_moves
        else "No robot pose changes: the hand-eye transform is held at the identity.",
    ]
    return [sentence for sentence in found if sentence]


def _uncertain_directions(fit: Fit, named: int = 3) -> tuple[str | None, str | None, str | None]:
    """Return sentences: undetermined directions, weak ones, and those of curves without pixels.

    Args:
        fit: The fitted model.
        named: Weak directions named, the weakest first; all are in report.json.
    """
    curves = {"c0", *(symbol for term, _ in fit.model.error.penalised() for symbol in term.symbols)}
    weak = [one for one in fit.observability.directions if one.sigma > _WEAK]
    of_curves = [one.sigma for one in weak if len(one.shares) > 1 and set(one.shares) <= curves]
    others = [one for one in fit.observability.directions if not set(one.shares) <= curves]
    free = "; ".join(one.in_words() for one in others if one.is_undetermined)
    weak = [one for one in others if one.sigma > _WEAK and not one.is_undetermined]
    words = [f"{1e3 * one.sigma:.1f} of {one.in_words()}" for one in weak[:named]]
    more = f"; and {len(weak) - len(words)} more" if len(weak) > len(words) else ""
    number = "1 direction" if len(of_curves) == 1 else f"{len(of_curves)} directions"
    verb = "is" if len(of_curves) == 1 else "are"
    return (
        f"The images do not determine {free}: a prior of {1e3 * PRIOR_SIGMA:g} mm and "
        f"{1e3 * PRIOR_SIGMA:g} mrad around the starting guess is used instead."
        if free
        else None,
        f"Standard errors above {1e3 * _WEAK:g} mm (or mrad): {'; '.join(words)}{more}."
        if words
        else None,
        f"{number} of the curves {verb} set by the smoothing penalty, not by data, "
        f"with a standard deviation of up to {1e3 * max(of_curves):.0f} mm: the recording does not "
        "hold those combinations of distance and amplitude."
        if of_curves
        else None,
    )


def _compared(fitted: float, held_out: float, bare: float) -> str | None:
    """Compare the held-out error with that of the fit and of the hand-eye alone."""
    if math.isnan(held_out):
        return _NOTHING_HELD_OUT
    if held_out > _OVERFITTED * fitted:
        return (
            f"The held-out error ({held_out:.1f} mm RMS) is much larger than that of the fit "
            f"({fitted:.1f} mm): record more views, or choose a smaller model."
        )
    compared = f"({held_out:.1f} mm RMS) than the hand-eye alone ({bare:.1f} mm)"
    if held_out > _WORSE * bare:
        return f"The depth correction makes held-out frames worse {compared}: do not use it."
    if held_out > bare:
        return (
            f"The depth correction leaves no less on held-out frames {compared}: this camera has "
            "hardly an error that the model describes, and the hand-eye transform is enough."
        )
    return None


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
    for stage, text in error_cells(report, unknown="-").items():
        name = stage.replace("hand_eye", "hand-eye").replace("_", " ")
        lines.append(f"{name:<16}{text[0]:>9}{text[1]:>9}{text[2]:>11}{text[3]:>9}")
    if report["hand_eye"]["estimated"]:
        lines += _hand_eye_lines(report)
    if advice := report["advice"]:
        lines.append(
            f"The largest standard error is {advice['worst_sigma_mm_or_mrad']:.2f} mm (or mrad), "
            f"of {report['observability']['weakest'][0]['direction']}. To lower it, add:"
        )
        lines += [
            f"  {pose['target']:<14}{pose['distance_m']:6.2f} m, tilted {pose['tilt_deg']:.0f} "
            f"deg, rolled by {pose['roll_by_deg']:+.0f}: then {pose['worst_sigma_mm_or_mrad']:.2f}"
            for pose in advice["poses"]
        ]
    found = [warning for warning in report["warnings"] if warning != report["reason"]]
    lines += [f"Warning: {warning}" for warning in found[:most_warnings]]
    if len(found) > most_warnings:
        lines.append(f"{len(found) - most_warnings} more warnings are in report.json.")
    return "\n".join([*lines, f"Verdict: {report['verdict']}. {report['reason']}"])


def error_cells(report: Mapping[str, Any], unknown: str) -> dict[str, list[str]]:
    """Return mean absolute and RMS errors, fitted and held out, of each stage as text, mm."""
    columns = [(half, kind) for half in ("train", "test") for kind in ("mean_abs", "rms")]
    return {
        stage: [
            unknown if (one := halves[half][kind]) is None else f"{one:.2f}"
            for half, kind in columns
        ]
        for stage, halves in report["error_mm"].items()
    }


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
