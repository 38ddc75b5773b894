"""Checks of geometry: do depth, poses, planes and camera agree, and if not, what explains it?

Limits of distances: "chosen" against clean recordings, of which `benchmarks.faults_in_recordings`
shows how many pass.
"""

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from tofcorr.geometry.rays import (
    multiples_in_words,
    range_of_wrapped,
    unambiguous_range,
    wrapped,
)
from tofcorr.plausibility.alignment import walls_of
from tofcorr.plausibility.finding import Finding, doubtful, impossible, in_words, note
from tofcorr.plausibility.linear import Estimate, length_scale, places_on_wall
from tofcorr.plausibility.look import Look
from tofcorr.plausibility.mounting import remounting

if TYPE_CHECKING:
    from tofcorr.plausibility.mistakes import Explanation

FAR_OFF = 0.1
"""Distance along the ray from its plane from which a pixel is garbage or wrapped, metres. Chosen:
errors of a camera are centimetres."""

# Misfit from which a mistake makes a fit meaningless, metres. Chosen: below, a fit is wrong by
# about as much as it is to correct.
_MEANINGLESS = 0.025
# An estimate counts from so many of its standard errors on. Chosen: of 560 estimates in 62 clean
# recordings none reached four.
_SIGMAS = 5.0
# Misfit of a frame from which no wall is seen at all, no alignment can be believed, or no
# calibration used, metres. Chosen.
_HOPELESS = 0.05
# Error in proportion to the distance, after the prior of the alignment, from which on the usual
# mistakes are tried and which heads a report. Chosen: of 319 cameras of other generators without
# such a fault one in 30 had more (up to 5 %).
_ODD_SLOPE = 0.03
# Constant error of a camera's distances that is worth a note, metres. Chosen.
_LARGE_CONSTANT = 0.2


def lone_walls(look: Look, fewest: int = 3, most: float = 0.5) -> Iterator[Finding]:
    """Are walls at unknown places seen often enough to be one wall? Only where walls are fitted.

    Args:
        look: The recording.
        fewest: Frames of a wall at an unknown place: one frame determines about the three unknowns
            of the wall itself, as in training.
        most: Share of the frames that may show walls of fewer: the others still fix the hand-eye.
    """
    if not look.fits or look.planes != "unknown":
        return
    wall = walls_of(look.scene)
    few = np.bincount(wall)[wall] < fewest
    if few.mean() <= most:
        return
    remedy = "measure the planes, or record the poses of a robot"
    if look.data.moves:
        remedy = "give all frames of one wall the same nx, ny, nz, d and target in frames.csv"
    yield impossible(
        f"{few.sum()} of {len(wall)} frames have a plane that fewer than {fewest} frames "
        "share, and the planes are to be estimated: a fit could place each wall where its "
        f"frame measured it, and would leave no error at all; {remedy}.",
        check="lone_walls",
    )


def garbage(look: Look, some: float = 0.003) -> Iterator[Finding]:
    """Do the pixels of a frame lie on one plane? A share `some` that does not is worth a note."""
    if not look.scene.known.any():
        return
    if look.flatness > _HOPELESS:
        yield Finding(
            "impossible" if look.fits else "doubtful",
            f"The points of a frame lie {1e3 * look.flatness:.0f} mm off a plane of their own: the "
            "target is not flat, the mask shows something else, or the depth is decoded "
            "wrongly.",
        )
        return
    share, bent, dominated = garbage_of(look)
    if share < some and not bent:
        return
    what = "edges, reflections or other surfaces"
    frequency, far = look.recording.modulation_frequency, _far_off(look)
    if frequency is not None and range_of_wrapped(far[far > 0], frequency) is not None:
        what = f"most by {_range_in_words(frequency)}, so they show a target beyond it"
    advice = "mask them (mask.npy, or `mask: ransac` in the configuration)"
    if bent or dominated:  # See `training.left_out`.
        advice = (
            "`tofcorr train`, `evaluate` and `select` leave them out, unless their configuration "
            "says which pixels count; mask.npy does so for every command"
        )
    yield Finding(
        "doubtful" if bent else "note",
        f"{100 * share:.1f} % of the pixels lie more than {1e3 * FAR_OFF:.0f} mm off the plane "
        f"of their frame: {what}; {advice}.",
    )


def garbage_of(
    look: Look, many: float = 0.01, pull: float = 0.007, of_squares: float = 4.0
) -> tuple[float, bool, bool]:
    """Return the share of pixels far off their frame's plane, and what they do to a fit.

    Args:
        look: The recording.
        many: Share that bends a plane of least squares: 1 % of pixels 0.7 m off do so by 7 mm.
        pull: Mean over all pixels of how far garbage is off that does as much, metres.
        of_squares: Squares of garbage, in times those of all other pixels, from which it dominates
            a fit: they double the standard errors of least squares.

    Returns:
        The share, whether they bend a fit, and whether they make most of what a fit minimises.
    """
    off = _far_off(look)
    if not len(off):
        return 0.0, False, False
    share = float((off > 0).mean())
    others = float(np.mean(look.scene.flatness[look.scene.known] ** 2))
    dominated = float(np.mean(off**2)) > of_squares * others
    return share, bool(share >= many or off.mean() >= pull), dominated


def _far_off(look: Look, sigmas: float = 8.0) -> np.ndarray:
    """Return how far each usable pixel is off, shape (M,), metres; zero up to the limit."""
    known = look.scene.known
    off = np.abs(look.scene.off_by[known])
    limit = np.maximum(FAR_OFF, sigmas * look.scene.flatness[known])[:, None]
    return np.where(off > limit, off, 0.0)[np.isfinite(off)]


def _range_in_words(frequency: float) -> str:
    """Return the unambiguous range of a modulation frequency (Hz), to follow "off by"."""
    multiples = multiples_in_words(unambiguous_range(frequency))
    return f"{multiples} of {1e-6 * frequency:.4g} MHz"


def _wrapping(look: Look, many: float = 0.1) -> Iterator[Finding]:
    """Is the target beyond the unambiguous range, where it is measured one range nearer?

    Args:
        look: The recording.
        many: Share of the pixels that must be whole ranges off the recorded planes to explain why
            frames are: fewer do not put a third of the frames off, and they are garbage.
    """
    frequency, given, scene = look.recording.modulation_frequency, look.given, look.scene
    if frequency is None or look.planes != "known":
        return
    normal, offset = scene.planes_in_tool()
    height = (normal @ given.hand_eye[:3, 3] + offset)[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        true = -height / np.einsum("fpa,fa->fp", scene.rays, normal @ given.hand_eye[:3, :3])
    errors = scene.distance - (1 + given.slope) * true - given.constant
    errors = errors[np.isfinite(errors)]
    share = float(wrapped(errors, frequency).mean()) if len(errors) else 0.0
    if share < many or range_of_wrapped(errors[np.abs(errors) > FAR_OFF], frequency) is None:
        return
    yield Finding(
        "impossible" if look.fits else "doubtful",
        f"{100 * share:.0f} % of the pixels are off the recorded planes by "
        f"{_range_in_words(frequency)}: they show targets beyond it. Mask them, or record nearer "
        "than that.",
        spoils=True,
        check="wrapping",
    )


def normals(look: Look, turned_deg: float = 135.0) -> Iterator[Finding]:
    """Do the planes' normals point to the camera? Exactly turned round they are 180 degrees off."""
    found = look.as_given
    if found is None or look.planes != "known" or found.misfit > _HOPELESS:
        return
    # A few noisy pixels tell their plane badly. A turned normal has the camera behind its plane.
    normal, offset = look.scene.planes_in_tool()
    behind = normal @ found.hand_eye[:3, 3] + offset < 0
    away = np.flatnonzero((np.degrees(np.nan_to_num(found.angle)) > turned_deg) & behind)
    if not len(away):
        return
    frames = tuple(look.frames[away].tolist())
    which = "all frames" if len(away) == len(found.angle) else in_words(frames)
    yield impossible(
        f"The normals of the planes point away from the camera in {which}, by "
        f"{np.degrees(np.median(found.angle[away])):.0f} degrees: write -nx, -ny, -nz, -d.",
        frames,
    )


def shape(look: Look, far_off: float = 0.03, unsure: float = 0.1) -> Iterator[Finding]:
    """Has the image the K and the distortion, and the depth the kind, that the header says?

    Args:
        look: The recording.
        far_off: Distance of the frames to their planes above which poses or planes are wrong, and
            shape cannot be told, metres.
        unsure: Largest standard error at which the kind is looked at: 0 is the declared one, 1 the
            other one.
    """
    if look.shape is None:
        return
    if float(np.median(look.of_camera.frame_rms(look.shape["kind"].left))) > far_off:
        return
    declared = look.recording.depth_kind
    other = "z" if declared == "radial" else "radial"
    kind = look.shape["kind"]
    share = float(kind.value[0])
    if kind.size_error < unsure and abs(share - 1) < 0.5:
        yield impossible(
            f"recording.yaml says depth_kind: {declared}, but walls are bent as if the depth were "
            f"{other} ({100 * share:.0f} % of the difference, standard error "
            f"{100 * kind.size_error:.0f} %); write depth_kind: {other}.",
            check="kind",
        )
        return
    wrong = _wrong_camera(look.shape)
    yield from _curved(look, look.shape["curvature"]) if wrong is None else [wrong]


_CAMERA: dict[str, tuple[str, float, str]] = {
    "focal": ("focal length", 0.03, "the focal length were {size:.0f} % {longer}"),
    "aspect": (
        "focal length",
        0.03,
        "the horizontal focal length were {size:.0f} % {longer}, the vertical one as it is",
    ),
    "centre": (
        "principal point",
        0.04,
        "the principal point lay {first:+z.0f} % of the focal length to the right and "
        "{second:+z.0f} % further down",
    ),
    "corner": (
        "distortion",
        0.005,
        "the distortion moved the corners of the image {size:.1f} % of the focal length further "
        "{out}",
    ),
    "bend": (
        "distortion",
        0.005,
        "the image's axes were bent, its corners {first:+.1f} % of the focal length to the right "
        "and {second:+.1f} % further down, as by a wedge of glass or a tilted lens",
    ),
}
"""By estimate: the finding, from which size on it counts, in focal lengths, and what would fit
better. Chosen: 3 % of the focal length bend a wall tilted by 30 degrees by a centimetre at the
border; 2 degrees of the principal point; 0.5 % at the corner bends it by 3 mm per metre."""


def _wrong_camera(
    found: dict[str, Estimate], unsure: float = 0.03, other_camera: float = 0.25
) -> Finding | None:
    """Judge K and distortion, and say what is most surely wrong.

    Args:
        found: Estimates of the errors of the image's shape.
        unsure: Largest standard error at which one is looked at.
        other_camera: Error of the focal length that makes a fit meaningless.
    """
    surely = {
        name: one.size / one.size_error
        for name, (_, least, _) in _CAMERA.items()
        if (one := found[name]).size > max(least, _SIGMAS * one.size_error)
        and one.size_error < unsure
    }
    if not surely:
        return None
    name = max(surely, key=surely.__getitem__)
    one, (check, _, words) = found[name], _CAMERA[name]
    first, second = 100 * one.value[0], 100 * one.value[-1]
    longer, out = ("longer", "out") if first > 0 else ("shorter", "in")
    better = words.format(size=abs(first), first=first, second=second, longer=longer, out=out)
    return Finding(
        "impossible" if name == "focal" and one.size > other_camera else "doubtful",
        f"Walls fit better if {better} (standard error {100 * one.size_error:.1f} %): are K and "
        "distortion of this camera, of this resolution and crop, and of images as they are here, "
        "rectified or not?",
        spoils=True,
        check=check,
    )


def _curved(look: Look, found: Estimate, least: float = 0.01) -> Iterator[Finding]:
    """Judge whether the target itself is bent, by as much as is calibrated (`least`, metres)."""
    used = look.of_camera.used
    half_width = float(np.quantile(np.hypot(*places_on_wall(look.of_camera))[used], 0.9))
    curvature = np.abs(found.value)
    sag = curvature * half_width**2
    if ((sag > least) & (curvature > _SIGMAS * found.error)).any():
        yield doubtful(
            f"The target is bent by {1e3 * float(sag.max()):.0f} mm within {half_width:.1f} m of "
            "its middle, from wherever it is seen: use a flat one, or mask what is not.",
            spoils=True,
            check="target",
        )


def drift(look: Look) -> Iterator[Finding]:
    """Do poses, wall and camera agree as well at the end of a recording as at its beginning?"""
    found = look.drift
    if found is not None:
        # Frames miss their planes by a quarter of it in the middle of each half.
        meaningless = found.size > 4 * _MEANINGLESS
        yield Finding(
            "impossible" if meaningless else "doubtful",
            f"From the first frame to the last the points move {1e3 * found.size:.0f} mm off the "
            f"recorded planes (standard error {1e3 * found.size_error:.0f} mm): the poses drift, "
            "or robot, target or camera was moved while recording; record again, or in parts.",
        )


def agreement(
    look: Look, suspicious: float = 0.005, of_flatness: float = 0.5, odd_constant: float = 0.15
) -> Iterator[Finding]:
    """Do poses, planes and depth agree, and if not, which usual mistake explains it?

    Args:
        look: The recording.
        suspicious: Distance of whole frames from their planes, metres, from which mistakes are
            undone, and which is doubtful if none explains it: of 72 clean recordings the most had
            2.5 mm. Where errors of the camera cannot be told, 12 and 30 mm.
        of_flatness: The same in times the flatness of the walls, since noise of the pixels moves
            planes as well: of 60 clean recordings none had more than both.
        odd_constant: Constant error of the distance from which mistakes are undone, metres.
    """
    given = look.as_given
    if given is None:
        return
    excess = _excess(look)
    fine = max(suspicious, of_flatness * look.flatness)
    tried, doubtful = (fine, fine) if look.shape is not None else (0.012, 0.03)
    odd = abs(given.constant) > odd_constant or abs(given.slope) > _ODD_SLOPE
    if excess < tried and not odd:
        yield from _scale(look)
        return
    from tofcorr.plausibility.mistakes import best_explanations  # Of use to few recordings.

    named = best_explanations(look)
    if named:
        yield _explained(look, named)
    elif excess > doubtful:
        # A camera that moved on the tool explains it, unless by far too much.
        moved = [] if excess > _HOPELESS else list(remounting(look))
        yield from moved or list(_wrapping(look)) or [_unexplained(look, excess)]
    else:
        yield from _scale(look)
        if abs(given.constant) > _LARGE_CONSTANT:
            yield note(
                f"The distances are {1e3 * given.constant:+.0f} mm off on the whole, much for a "
                "camera: is this the depth of the target, and in metres?"
            )


def _excess(look: Look) -> float:
    """Return how far frames are off their planes as wholes, metres.

    Root mean square over the frames that do not disagree with all others; where errors of the
    camera cannot be told, of the median frame, beyond the flatness of the walls.
    """
    if look.planes_off is None:
        return math.sqrt(max(float(np.median(look.rms)) ** 2 - look.flatness**2, 0.0))
    off = look.planes_off[~np.isin(look.frames, list(outlying_frames(look)))]
    return math.sqrt(float(np.nanmean(off**2))) if np.isfinite(off).any() else 0.0


def _explained(
    look: Look, named: "list[Explanation]", of_planes: float = 0.06, turned_deg: float = 15.0
) -> Finding:
    """Return what says which mistake it is.

    Where only the planes are wrong, a fit is meaningless from `of_planes` metres or `turned_deg`
    on: planes a few degrees off are what `diagnose` finds as target_registration.
    """
    from tofcorr.plausibility.mistakes import WRONG_PLANES

    (cause, advice, found, frees), given = named[0], look.given
    # A mirrored image and a mirrored world look alike; say both.
    others = [more for more, other, _, freed in named if other != advice and not freed]
    also = f" (as likely: {others[0]})" if others and not frees else ""
    fatal = cause != WRONG_PLANES
    turned = not fatal and math.degrees(given.typical_angle) > turned_deg
    meaningless = given.badness > (_MEANINGLESS if fatal else of_planes) or turned
    return Finding(
        "impossible" if meaningless else "doubtful",
        f"{_misfit(look)}, and by {_mm(found.misfit)} if one mistake is undone: {cause}"
        f"{also}; {advice}.",
        spoils=True,
    )


def _unexplained(look: Look, excess: float, unusable: float = 0.008) -> Finding:
    """Return what says that no mistake explains the misfit; `unusable` metres spoil a fit."""
    hints = "; if nobody measured the planes, use `planes: unknown`"
    hints = hints if look.planes == "known" else ""
    # Without the frequency, waves of the circular error cannot be told from wrong poses.
    if look.recording.modulation_frequency is None:
        hints += "; state `modulation_frequency_hz` if you know it"
    far = int((look.rms > _HOPELESS).sum())
    others = f", {far} of {len(look.rms)} frames more than {_mm(_HOPELESS)}" if far else ""
    return Finding(
        "impossible" if excess > _HOPELESS else "doubtful",
        f"{_misfit(look)}{others}, and no usual mistake explains it: poses, planes or depth are of "
        f"something else, or the poses scatter{hints}.",
        spoils=excess > unusable,
    )


def _misfit(look: Look) -> str:
    given, angle = look.given, math.degrees(look.given.typical_angle)
    turned = f" and {angle:.0f} degrees" if angle >= 2 else ""
    far = abs(given.constant) > _LARGE_CONSTANT
    constant = f", with all distances {1e3 * given.constant:+.0f} mm off" if far else ""
    return (
        f"After the best alignment of the camera the points lie {_mm(given.misfit)}{turned} off "
        f"the {'walls' if look.planes == 'unknown' else 'recorded planes'}{constant}"
    )


def _mm(metres: float) -> str:
    return f"{1e3 * metres:.0f} mm" if metres < 10 else f"{metres:.0f} m"


def _scale(
    look: Look, other_unit: float = 0.15, least_length: float = 2e-3, unsure: float = 0.005
) -> Iterator[Finding]:
    """Do robot and camera agree on lengths?

    Args:
        look: The recording.
        other_unit: Error in proportion to the distance that is another unit.
        least_length: Difference of the hand-eye's length that is worth a note, metres: below, other
            errors are as large.
        unsure: Standard error up to which a scale is looked at.
    """
    given = look.given
    if abs(given.slope) > other_unit:
        yield impossible(
            f"All distances are {100 * given.slope:+.0f} % off against the poses: depth or "
            "poses are in another unit, or scaled.",
            spoils=True,
            check="scale",
        )
        return
    share, error = 0.0, math.inf
    if look.linear is not None and look.scene.moves:
        share, error = length_scale(given, look.linear)
    if error > unsure:
        share, error = given.slope, math.inf
    length = abs(share) * float(math.hypot(*given.hand_eye[:3, 3]))
    heads = abs(given.slope) > _ODD_SLOPE
    if not heads and not (length > least_length and abs(share) > _SIGMAS * error):
        return
    uncertain = f" (standard error {100 * error:.2g} %)" if error <= unsure else ""
    yield Finding(
        "ambiguous" if heads else "note",
        f"The camera's distances are {100 * abs(share):.1f} %{uncertain} "
        f"{'longer' if share > 0 else 'shorter'} than the robot's lengths, and this "
        "recording cannot tell which of them is right; if the camera's are, a fit makes the "
        f"hand-eye translation {1e3 * length:.1f} mm too {'short' if share > 0 else 'long'}.",
        check="scale",
    )


def outlying_poses(look: Look) -> Iterator[Finding]:
    """Does the pose or the plane of single frames disagree with all others?"""
    if off := outlying_frames(look):
        amounts = ", ".join(f"{1e3 * value:.0f}" for value in list(off.values())[:5])
        yield doubtful(
            f"{in_words(tuple(off)).capitalize()} {'disagrees' if len(off) == 1 else 'disagree'} "
            f"with all others by {amounts} mm (median {1e3 * float(np.median(look.rms)):.0f} mm): "
            "wrong poses, planes or images; train, evaluate and select leave them out.",
            tuple(off),
        )


def outlying_frames(
    look: Look, times: float = 5.0, least: float = 0.02, most: float = 0.3, fewest: int = 6
) -> dict[int, float]:
    """Return the misfit of every frame that disagrees with all others, metres, the worst first.

    Args:
        look: The recording.
        times: A frame disagrees if its misfit is so many times the median's,
        least: and so many metres; twice that where errors of the camera cannot be taken off first.
        most: Share of the frames up to which they are single ones: the alignment is robust to it.
        fewest: Frames among which one can disagree: the alignment takes three.
    """
    if look.as_given is None or len(look.rms) < fewest:
        return {}
    rms, limit = look.rms, 2 * least if look.shape is None else least
    off = np.flatnonzero(rms > max(times * float(np.median(rms)), limit))
    if len(off) > most * len(rms):
        return {}
    return {int(look.frames[k]): float(rms[k]) for k in off[np.argsort(-rms[off])]}
