"""What a training says of itself: what it leaves out, verdict, warnings, text of the report."""

import json
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np

from tofcorr.digits import aligned, at_most, with_interval
from tofcorr.errors import CalibrationDataError
from tofcorr.estimation.uncertainty import PRIOR_SIGMA
from tofcorr.files import reading
from tofcorr.fit.problem import Fit
from tofcorr.geometry.camera import FrameNames
from tofcorr.pixels.sample import MaskOptions
from tofcorr.plausibility.finding import FAR_OFF, SPOILS, Inspection, in_words
from tofcorr.plausibility.look import Look
from tofcorr.training.calibration import TrainingOptions
from tofcorr.training.support import Support, shortcomings

Training = TypeVar("Training", bound=TrainingOptions)
Verdict = Literal["good", "usable", "do not use"]
DO_NOT_USE: Verdict = "do not use"
VERDICTS: tuple[Verdict, ...] = (DO_NOT_USE, "usable", "good")

# What a verdict and the warnings compare with; errors are root mean squares.
#
# Largest standard error of the hand-eye of a good run, metres or radians: the size of the errors
# that a calibration is to remove. Above it a direction is weak.
_WEAK = 5e-3
# Held-out over fitted error above which a model is too large; and held-out error over that of the
# hand-eye alone from which the correction makes things worse, a twentieth being within the chance
# of a split, or gains nothing. A camera without errors reaches the noise with the hand-eye alone:
# what is beyond says that poses or planes are wrong.
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


def frames_left_out(inspection: Inspection, training: Iterable[np.ndarray]) -> tuple[int, ...]:
    """Return the frames that disagree with all others; none where too few would be left.

    Args:
        inspection: What was odd about the recordings.
        training: Global numbers of the frames to fit, an array a fit.
    """
    frames = tuple(inspection.outlying)
    # As many to fit on as `split_frames` asks for, and one more.
    enough = all((~np.isin(own, frames)).sum() >= 4 for own in training)
    return frames if enough else ()


def left_out_words(frames: Sequence[int]) -> list[str]:
    """Return one sentence about frames left out; none if there is none."""
    which = f"{in_words([*frames]).capitalize()} {'is' if len(frames) == 1 else 'are'} left out of"
    said = f"{which} all fits and errors: poses, planes or images disagree with all others."
    return [said] if frames else []


def outlying_words(images: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return one sentence about the images that fit much worse than the others; none if none do."""
    worst = ", ".join(f"{one['rms_mm']:.1f}" for one in images[:5])
    named = in_words([one["frame"] for one in images]).capitalize()
    return [f"{named}: the fit is much worse than elsewhere, {worst} mm RMS."] if images else []


def left_out_mapping(frames: Iterable[int], inspection: Inspection) -> list[dict[str, Any]]:
    """Return frames left out and by how much they disagree, the worst first: plain values."""
    chosen, outlying = set(frames), inspection.outlying.items()
    return [{"frame": frame, "off_mm": 1e3 * off} for frame, off in outlying if frame in chosen]


def judge(
    fit: Fit, errors: Mapping[str, Any], support: Support, inspection: Inspection
) -> tuple[Verdict, str, list[str]]:
    """Return the verdict, its reason, and what a user must know before trusting the result.

    The reason is the first of what speaks against a run, or for it. What has one cause is said
    once.

    Args:
        fit: The fitted model.
        errors: The `error_mm` of the report.
        support: What the fitted frames cover.
        inspection: What was odd about the recordings; its noise of a pixel is the floor.
    """
    free = _is_free(fit)
    said = [*_of_errors(fit, errors, inspection.look), *_of_directions(fit)]
    needed = shortcomings(support, moves=free, with_intensity=fit.model.error.needs_amplitude())
    for serious, one in needed:
        said.append(("usable" if serious else "good", one))
    noise = 1e3 * inspection.look.noise_rms
    if beyond := beyond_noise(errors["after"]["test"]["rms"], noise, moves=free):
        said.append(("usable", beyond))
    # From n images a standard error is known to about 1 / sqrt(2 (n - 1)), a quarter for ten.
    if (images := len(fit.moments.gram)) < 10:
        said.append(("good", f"Only {images} images were fitted: standard errors are rough."))
    if fit.residual:
        said.append(("good", fit.residual))
    if support.roll_deg is None:
        said.append(("good", "No robot moves: the hand-eye transform is held at the identity."))
    spoilt = [one for one in inspection.findings if one.spoils or one.severity == "impossible"]
    odd: list[tuple[Verdict, str]] = [(DO_NOT_USE, one.sentence) for one in spoilt]
    if inspection.headline:
        odd.append(("usable", inspection.headline))
    first = dict(reversed([*odd, *said]))
    first["good"] = expected(fit, errors, inspection)
    verdict: Verdict = min(first, key=VERDICTS.index)
    return verdict, first[verdict], [sentence for _, sentence in said]


def expected(fit: Fit, errors: Mapping[str, Any], inspection: Inspection) -> str:
    """Return the error to expect in use: of held-out frames, and of the hand-eye transform.

    Arguments are those of `judge`.
    """
    known = f", and the hand-eye is known to {_known(fit)} (1 σ)." if _is_free(fit) else "."
    return f"{_measured(fit, errors, inspection.look)}{known}"


def _is_free(fit: Fit) -> bool:
    return fit.solution.parameters.hand_eye_is_free


def _known(fit: Fit) -> str:
    # Beyond the wide prior a standard error says no more than that nothing is known.
    wide = f"no better than {1e3 * PRIOR_SIGMA:.0f}"
    sizes = [f"{1e3 * one:.1f}" if one < PRIOR_SIGMA else wide for one in fit.hand_eye_errors]
    return "{} mm and {} mrad".format(*sizes)


def _measured(fit: Fit, errors: Mapping[str, Any], look: Look) -> str:
    """Return how far held-out frames are off, compared with the hand-eye alone and with noise."""
    held_out, bare = (errors[stage]["test"]["rms"] for stage in ("after", "hand_eye_only"))
    if held_out is None:
        return "No frame was held out: the errors given are those of the fit itself"
    alone = "with the hand-eye alone" if _is_free(fit) else "without correction"
    compared = f"{bare:.1f} mm {alone}"
    compared += f", {1e3 * look.noise:.1f} mm noise of a pixel" if look.noise > 0 else ""
    return f"Held-out frames are off by {held_out:.1f} mm RMS ({compared})"


def _of_errors(fit: Fit, errors: Mapping[str, Any], look: Look) -> Iterator[tuple[Verdict, str]]:
    """Yield what the errors say of a fit.

    Args:
        fit: The fitted model.
        errors: The `error_mm` of the report.
        look: What the recordings look like.
    """
    noise, measured = 1e3 * look.noise, _measured(fit, errors, look)
    halves = ("after", "train"), ("after", "test"), ("hand_eye_only", "test")
    found = [errors[stage][half]["rms"] for stage, half in halves]
    fitted, held_out, bare = (math.nan if one is None else one for one in found)
    # Of all pixels to planes of their own frames, which no pose and no recorded plane changes.
    own = look.scene.off_by[look.scene.known]
    flat = 1e3 * float(np.sqrt(np.nanmean(np.square(own)))) if own.size else math.nan
    least = min(3 * flat, math.hypot(flat, 1e3 * SPOILS))
    error = fitted if math.isnan(held_out) else held_out
    if fit.solution.stopped == "not_finite":
        smaller = "Choose a smaller model, or see `tofcorr inspect`."
        yield DO_NOT_USE, f"{fit.solution.message} {smaller}"
    # Shorter distances have smaller noise, so that unknown walls move nearer. No camera's error
    # grows by a third of the distance.
    if fit.walls is not None and fit.gain < 2 / 3:
        left = f"Where 1 m is measured, the fit leaves {fit.gain:.2f} m"
        yield DO_NOT_USE, f"{left}. Record poses nearer and farther, or measure the wall's plane."
    # No model can foresee noise: below a tenth of it a fit has collapsed.
    if not fitted >= noise / 10 and math.isfinite(noise):
        left = f"The fit leaves {fitted:.2g} mm of {noise:.1f} mm noise"
        yield DO_NOT_USE, f"{left}: too few different frames."
    if held_out > _WORSE * bare:
        yield DO_NOT_USE, f"{measured}: the depth correction makes them worse."
    elif held_out > max(_NO_GAIN * bare, least) and beyond_noise(held_out, flat):
        why = f"nothing is gained. Frames are flat to {flat:.1f} mm: poses or planes are wrong"
        yield DO_NOT_USE, f"{measured}: {why}."
    # No application bears 30 mm, the raw error of most cameras, or eight times the noise.
    if error > max(30, 8 * noise):
        off = f"Frames are off by {error:.0f} mm RMS after the fit"
        yield DO_NOT_USE, f"{off}: the model does not describe them."
    if math.isnan(held_out):
        yield "usable", f"{measured}."
    if held_out > _OVERFITTED * fitted:
        own = f"much more than the {fitted:.1f} mm of the fit itself"
        yield "usable", f"{measured}, {own}: record more views, or choose a smaller model."
    elif bare < held_out <= _WORSE * bare:
        yield "good", f"{measured}: the depth correction gains nothing."


def _of_directions(fit: Fit) -> Iterator[tuple[Verdict, str]]:
    """Yield what a fit lacks, and in what it is uncertain: the weakest direction by name."""
    solution, free = fit.solution, _is_free(fit)
    if fit.misfit is not None:
        yield "usable" if max(fit.misfit.size) > _WEAK else "good", fit.misfit.lacking()
    if not solution.converged and solution.stopped != "not_finite":
        yield "usable", solution.message
    if free and max(fit.hand_eye_errors) > _WEAK:
        yield "usable", "The hand-eye is known too roughly: record more tilts and distances."
    wide, of_pose = 1e3 * PRIOR_SIGMA, "usable" if free else "good"
    curves = {"c0", *(symbol for term, _ in fit.model.error.penalised() for symbol in term.symbols)}
    weak = [one for one in fit.directions if one.sigma > _WEAK and not fit.is_unseen(one)]
    of_curves = [one.sigma for one in weak if len(one.shares) > 1 and set(one.shares) <= curves]
    others = [one for one in weak if not set(one.shares) <= curves]
    held = f"a prior of {wide:g} mm and {wide:g} mrad is used"
    if undetermined := [one.in_words() for one in others if one.is_undetermined]:
        lacking = f"{'; '.join(undetermined)}: {held}"
        yield of_pose, f"The images do not determine {lacking}. Record more tilts and distances."
    if hidden := [one.in_words() for one in fit.directions if fit.is_unseen(one)]:
        yield "good", f"From no pose does one ray show {'; '.join(hidden)}: {held}."
    if uncertain := [one for one in others if not one.is_undetermined]:
        worst = f"the largest is {1e3 * uncertain[0].sigma:.1f}, of {uncertain[0].in_words()}"
        count = f"{len(uncertain)} standard errors are above {1e3 * _WEAK:g} mm (or mrad)"
        yield "good", f"{count}; {worst}."
    if of_curves:
        size = f"their standard deviations reach {1e3 * max(of_curves):.0f} mm"
        yield "good", f"Parts of the curves are set by the smoothing penalty, not by data: {size}."


def beyond_noise(held_out: float | None, noise: float, *, moves: bool = True) -> str | None:
    """Return one sentence about an error that neither the model nor noise explains; None: small.

    Poses of an ordinary robot scatter by less than 1.5 mm, and edges raise the noise by a tenth:
    what is beyond, as a root of the difference of squares, is then below 0.6 times the noise.

    Args:
        held_out: RMS error of held-out frames, millimetres; None: no frame was held out.
        noise: Noise of their pixels, root mean square, millimetres; NaN: unknown.
        moves: Whether a robot moves the camera.
    """
    beyond = math.sqrt(max((held_out or 0.0) ** 2 - noise**2, 0.0))
    if not beyond > max(1.5, 0.6 * noise):
        return None
    off = f"Held-out frames are off by {beyond:.1f} mm beyond the noise of their pixels"
    off = f"{off}: {'poses' if moves else 'planes'} scatter, or the model lacks a term"
    return f"{off}; `tofcorr diagnose` tells which."


_POSE = (
    "{target}: {distance_m:.2f} m away, tilted {tilt_deg:.0f} deg, rolled {roll_by_deg:+.0f} deg"
)
_VIEWS = "between views (offset and tilts of whole images)", "within views"


def report_text(report: Mapping[str, Any]) -> str:
    """Return verdict, errors, hand-eye, what is least known and one warning, in a dozen lines.

    Args:
        report: The content of report.json.
    """
    return "\n".join(
        [
            verdict_text(report),
            *update_words(report)[:1],
            *_error_table(report, {"rms": "RMS"}),
            *scene_words(report),
            *_hand_eye_lines(report)[:1],
            *_advice_lines(report, 2),
            *at_most(2, _warnings(report), "--verbose, or report.json"),
        ]
    )


def full_text(report: Mapping[str, Any]) -> str:
    """Return all that `report_text` says in short.

    Args:
        report: The content of report.json.
    """
    lines = [verdict_text(report), *update_words(report), report["message"]]
    lines += _error_table(report, {"mean_abs": "mean abs.", "rms": "RMS"})
    lines += scene_words(report)
    for half, own in report["views_mm"].items():
        if own["rms_z"] is not None:
            lines.append(f"{half.replace('test', 'held out')}: RMS along z {own['rms_z']:.2f} mm")
            parts = zip(_VIEWS, (own["between_views"], own["within_views"]), strict=True)
            lines += [f"  {size:.2f} mm {part}" for part, size in parts]
            if own["within_prior"] != own["rms_z"]:  # Else no plane has a covariance.
                lines.append(f"  {own['within_prior']:.2f} mm with planes within their covariance")
    lines += _hand_eye_lines(report)
    if report["advice"]:
        lines += _advice_lines(report, len(report["advice"]["poses"]))
        lines.append(f"  In symbols it is {report['advice']['direction']}.")
    return "\n".join([*lines, *_warnings(report)])


def update_words(report: Mapping[str, Any]) -> list[str]:
    """Return what was known before: what has changed since, or what a diagnosis had named.

    Args:
        report: The content of report.json.
    """
    units = report.get("prior", {"units": []})["units"]
    own = [f"The prior is what {len(units)} units of its type have in common."] if units else []
    own = report.get("named", {"sentences": own})["sentences"]
    if (update := report.get("update")) is None:
        return own
    others = [
        f"{one['changed'].replace('_', ' ')} {one['probability']:.2g}"
        for one in update["explanations"][1:]
    ]
    others = f"Other explanations: {', '.join(others)}."
    return [update["sentence"], others, *own, *update["notes"]]


def scene_words(report: Mapping[str, Any]) -> list[str]:
    """Return what of the scene's light is removed, how well it is known, and what that changes.

    Args:
        report: The content of report.json; it has no `scene` where nothing was asked for.
    """
    scene, said = report.get("scene", {}), list[str]()
    if "stray_light" in scene:
        stray = scene["stray_light"]
        share = sum(stray["shares"]) + stray["veil"] + sum(stray["ghost_shares"])
        said.append(f"Stray light is taken back: {100 * share:.2g} % of the light.")
    if "second_bounces" in scene:
        bounces = scene["second_bounces"]
        gain, ends = with_interval(bounces["gain"], bounces["gain_interval"])
        known = f"{gain} (95 %: {ends}, from the curvature of walls)"
        known = known if ends else f"{bounces['gain']:.3g} (as given)"
        said.append(f"Second bounces are removed with the gain {known}.")
    half = "Held-out frames" if report["frames"]["test"] else "Frames fitted"
    for name in ("stray_light", "second_bounces"):
        if name in scene:
            left, without = (f"{rms:.1f}" for rms in scene[name]["held_out_rms_mm"])
            light = name.replace("_", " ")
            said.append(f"{half} are off by {left} mm RMS with {light} and {without} mm without.")
    if "flying_pixels" in scene:
        share = scene["flying_pixels"]["held_out_share"]
        shown = "not looked for: the recording shows none"
        shown = shown if share is None else f"{100 * share:.2g} % of all pixels"
        said.append(f"Flying pixels are {shown}.")
    return said


def _error_table(report: Mapping[str, Any], kinds: Mapping[str, str]) -> list[str]:
    """Return the errors of each stage on both halves, millimetres, as aligned columns."""
    halves = ("train", "training"), ("test", "held out")
    heads = [f"{half} {kind}, mm" for _, half in halves for kind in kinds.values()]
    rows = [[report["model"], *heads]]
    for stage, errors in report["error_mm"].items():
        own = [errors[half][kind] for half, _ in halves for kind in kinds]
        rows.append([stage_words(stage), *("-" if one is None else f"{one:.2f}" for one in own)])
    return aligned(rows)


def stage_words(stage: str) -> str:
    """Return what a stage of `error_mm` is called in tables and pictures."""
    return stage.replace("hand_eye", "hand-eye").replace("_", " ")


def advice_words(advice: Mapping[str, Any]) -> tuple[str, list[str]]:
    """Return what is least well known, and the poses that would help, the most helpful first.

    Args:
        advice: That of the report.
    """
    # Of more kinds than two a reader remembers the first two.
    mixed = " against the ".join(advice["of"][:2])
    poses = []
    for pose in advice["poses"]:
        lower = 1 - pose["worst_sigma_mm_or_mrad"] / advice["worst_sigma_mm_or_mrad"]
        poses.append(f"{_POSE.format(**pose)}: largest standard error {100 * lower:.0f} % lower")
    return f"Least well known: the {mixed}, to {advice['sigma_mm_or_mrad']:.1f} mm at 1 m.", poses


def _advice_lines(report: Mapping[str, Any], number: int) -> list[str]:
    """Return what is least well known, and the poses that would help most; empty without advice."""
    if not report["advice"]:
        return []
    known, poses = advice_words(report["advice"])
    helpful = " Poses that would help most, in this order:" if poses else ""
    return [known + helpful, *(f"  {one}" for one in poses[:number])]


def _warnings(report: Mapping[str, Any]) -> list[str]:
    """Return what a user must know beside the verdict, a line each."""
    said = [report["headline"] or "", *left_out_words([x["frame"] for x in report["left_out"]])]
    said += [*outlying_words(report["outlying_images"]), *report["warnings"]]
    return [f"Warning: {one}" for one in dict.fromkeys(said) if one not in ("", report["reason"])]


def verdict_text(report: Mapping[str, Any]) -> str:
    """Return verdict, what decides it, and the error to expect in use.

    Args:
        report: The content of report.json; older ones lack `expected`.
    """
    reason, expects = report["reason"], report.get("expected", "")
    said = expects if expects.startswith(reason.rstrip(".")) else reason
    said = f"Verdict: {report['verdict']}. {said}"
    return said if expects in said else f"{said} {expects}"


def _hand_eye_lines(report: Mapping[str, Any]) -> list[str]:
    """Return where the camera sits, how far noise moved that, and what else would move it."""
    hand_eye, shift = report["hand_eye"], report["hand_eye"]["noise_shift"]
    if not hand_eye["estimated"]:
        return []
    frames = hand_eye["frames"]
    named = frames != FrameNames().to_mapping()
    where = f" of {frames['camera']} in {frames['tool']}" if named else ""
    translation = [1e3 * row[3] for row in hand_eye["tool_from_camera"][:3]]
    pairs = zip("xyz", translation, hand_eye["translation_se_mm"], strict=True)
    known = ", ".join(f"{axis} {t:.2f} ± {error:.2f}" for axis, t, error in pairs)
    lines = [f"hand-eye translation{where}, mm: {known}"]
    if shift is not None:
        done = "taken off" if shift["removed"] else "not taken off; the standard errors contain it"
        millimetres = "  ".join(f"{t:+z.2f}" for t in shift["translation_mm"])
        lines.append(f"  moved by the noise of the distances, mm: {millimetres} ({done})")
    moved = [(math.hypot(*one["translation_mm"]), one["error"]) for one in report["assumptions"]]
    return lines + [f"  not in these ±: {size:.1f} mm for {error}" for size, error in moved]


def report_of_run(run: Path) -> dict[str, Any]:
    """Return the content of the report.json of a run.

    Raises:
        CalibrationDataError: There is none, or it is damaged.
    """
    file = run / "report.json"
    with reading(file):
        text = file.read_text(encoding="utf-8")
    try:
        return json.loads(text)
    except ValueError as error:
        raise CalibrationDataError(f"{file}: is no report ({error}).") from None


def verdict_of_run(run: Path) -> str:
    """Return what the report of a run says of it; nothing without one.

    Raises:
        CalibrationDataError: `tofcorr train` gave it no corrector.ts: it is not to be used; or its
            report is damaged.
    """
    if not (run / "report.json").is_file():
        return ""
    report = report_of_run(run)
    if report["verdict"] == DO_NOT_USE and not (run / "corrector.ts").exists():
        said = f"{run}: its verdict is `{DO_NOT_USE}`: {report['reason']}"
        raise CalibrationDataError(f"{said} Train with --force, if so.")
    return verdict_text(report)
