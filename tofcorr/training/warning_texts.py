"""The warnings of a training's report, one sentence each."""

from collections.abc import Mapping
from typing import Any

from tofcorr.estimation.information import PRIOR_SIGMA
from tofcorr.estimation.observability import Direction
from tofcorr.fit.result import Fit
from tofcorr.training.refusals import WORSE
from tofcorr.training.reservations import OVERFITTED, WEAK, beyond_noise
from tofcorr.training.support import Support, shortcomings

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
    found += _overfitting(errors)
    found += [] if fit.misfit is None else [fit.misfit.in_words()]
    found += filter(None, [beyond_noise(errors["after"]["test"]["rms"], noise_mm)])
    found += _undetermined(fit)
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


def _undetermined(fit: Fit) -> list[str]:
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


def _overfitting(errors: Mapping[str, Any]) -> list[str]:
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
