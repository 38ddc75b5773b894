"""Checks of geometry: do depth, poses, planes and camera agree, and if not, what explains it?

Limits of distances: "chosen" against clean recordings, of which `benchmarks.faults_in_recordings`
shows how many pass.
"""

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from tofcorr.geometry.rays import (
    mostly_wrapped,
    multiples_in_words,
    unambiguous_range,
    wrapped,
)
from tofcorr.plausibility.alignment import TINY, walls_of
from tofcorr.plausibility.finding import (
    CAMERA,
    FAR_OFF,
    HOPELESS,
    LARGE_CONSTANT,
    ODD_SLOPE,
    SIGMAS,
    SPOILS,
    Finding,
    doubtful,
    impossible,
    in_words,
    note,
)
from tofcorr.plausibility.linear import Estimate, length_scale, places_on_wall, pose_drift
from tofcorr.plausibility.look import Look
from tofcorr.plausibility.mounting import remounting

if TYPE_CHECKING:
    from tofcorr.plausibility.mistakes import Explanation


def lone_walls(look: Look) -> Iterator[Finding]:
    """Are walls at unknown places seen often enough to be one wall? Only where walls are fitted.

    One frame determines about the three unknowns of the wall itself. Half of the frames may show
    walls of fewer than three, as in training: the others still fix the hand-eye.
    """
    if not look.fits or look.planes != "unknown":
        return
    wall = walls_of(look.scene)
    few = np.bincount(wall)[wall] < 3
    remedy = "measure the planes, or record the poses of a robot"
    if look.data.moves:
        remedy = "give all frames of one wall the same nx, ny, nz, d and target in frames.csv"
    said = f"{few.sum()} of {len(wall)} frames have a plane that fewer than 3 frames share"
    error = "a fit of the planes could place each where its frame measured it, without any error"
    if few.mean() > 0.5:
        yield impossible(f"{said}: {error}; {remedy}.", check="lone_walls")


def garbage(look: Look) -> Iterator[Finding]:
    """Do the pixels of a frame lie on one plane? 3 of 1000 that do not are worth a note."""
    if not look.scene.known.any():
        return
    if look.flatness > HOPELESS:
        said = f"The points of a frame lie {1e3 * look.flatness:.0f} mm off a plane of their own"
        why = "the target is not flat, the mask shows something else, or the depth is misread"
        yield Finding("impossible" if look.fits else "doubtful", f"{said}: {why}.")
        return
    share, bent, dominated = garbage_of(look)
    if 1000 * share < 3 and not bent:
        return
    what = "edges, reflections or other surfaces"
    frequency, far = look.recording.modulation_frequency, _far_off(look)
    if frequency is not None and mostly_wrapped(far[far > 0], frequency):
        what = f"most by {_range_in_words(frequency)}, so they show a target beyond it"
    advice = "mask them (mask.npy, or `mask: ransac` in the configuration)"
    if bent or dominated:  # See `training.left_out`.
        advice = "fits leave them out unless told which pixels count; mask.npy does so everywhere"
    said = f"{100 * share:.1f} % of the pixels lie more than {1e3 * FAR_OFF:.0f} mm off the plane"
    yield Finding("doubtful" if bent else "note", f"{said} of their frame: {what}; {advice}.")


def garbage_of(look: Look) -> tuple[float, bool, bool]:
    """Return the share of pixels far off their frame's plane, and what they do to a fit.

    Returns:
        The share; whether they bend a fit: 1 % of pixels 0.7 m off bend a plane of least squares by
        7 mm; and whether they make most of what a fit minimises: squares of four times those of all
        other pixels double the standard errors of least squares.
    """
    off = _far_off(look)
    if not len(off):
        return 0.0, False, False
    share = float((off > 0).mean())
    others = float(np.mean(look.scene.flatness[look.scene.known] ** 2))
    dominated = float(np.mean(off**2)) > 4 * others
    return share, bool(100 * share >= 1 or 1000 * off.mean() >= 7), dominated


def _far_off(look: Look) -> np.ndarray:
    """Return how far each usable pixel is off, shape (M,), metres; zero up to the limit."""
    known = look.scene.known
    off = np.abs(look.scene.off_by[known])
    limit = np.maximum(FAR_OFF, 8 * look.scene.flatness[known])[:, None]
    return np.where(off > limit, off, 0.0)[np.isfinite(off)]


def _range_in_words(frequency: float) -> str:
    """Return the unambiguous range of a modulation frequency (Hz), to follow "off by"."""
    multiples = multiples_in_words(unambiguous_range(frequency))
    return f"{multiples} of {frequency / 1_000_000:.4g} MHz"


def _wrapping(look: Look) -> Iterator[Finding]:
    """Is the target beyond the unambiguous range, where it is measured one range nearer?

    A tenth of the pixels must be whole ranges off the recorded planes to explain why frames are:
    fewer do not put a third of the frames off, and they are garbage.
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
    if 10 * share < 1 or not mostly_wrapped(errors[np.abs(errors) > FAR_OFF], frequency):
        return
    severity = "impossible" if look.fits else "doubtful"
    by = f"off the recorded planes by {_range_in_words(frequency)}: they show targets beyond it"
    said = f"{100 * share:.0f} % of the pixels are {by}. Mask them, or go nearer."
    yield Finding(severity, said, spoils=True, check="wrapping")


def normals(look: Look) -> Iterator[Finding]:
    """Do the planes' normals point to the camera? Exactly turned round they are 180 degrees off."""
    found = look.as_given
    if found is None or look.planes != "known" or found.misfit > HOPELESS:
        return
    # A few noisy pixels tell their plane badly. A turned normal has the camera behind its plane.
    normal, offset = look.scene.planes_in_tool()
    behind = normal @ found.hand_eye[:3, 3] + offset < 0
    away = np.flatnonzero((np.degrees(np.nan_to_num(found.angle)) > 135) & behind)
    if not len(away):
        return
    frames = tuple(look.frames[away].tolist())
    which = "all frames" if len(away) == len(found.angle) else in_words(frames)
    off = f"{np.degrees(np.median(found.angle[away])):.0f} degrees"
    said = f"The normals of the planes point away from the camera in {which}, by {off}"
    yield impossible(f"{said}: write -nx, -ny, -nz, -d.", frames)


def shape(look: Look) -> Iterator[Finding]:
    """Has the image the K and the distortion, and the depth the kind, that the header says?

    Where poses or planes are wrong, that cannot be told.
    """
    if look.shape is None:
        return
    if float(np.median(look.of_camera.frame_rms(look.shape["kind"].left))) > CAMERA:
        return
    declared = look.recording.depth_kind
    other = "z" if declared == "radial" else "radial"
    kind = look.shape["kind"]
    share = float(kind.value[0])
    # 0 is the declared one, 1 the other one, from which it is so many standard errors.
    if 2 * SIGMAS * kind.size_error < 1 and abs(share - 1) < 0.5:
        said = f"recording.yaml says depth_kind: {declared}, but walls are bent as of {other}"
        sure = f"{100 * share:.0f} %, standard error {100 * kind.size_error:.0f} %"
        yield impossible(f"{said} ({sure}); write depth_kind: {other}.", check="kind")
        return
    wrong = _wrong_camera(look.shape)
    yield from _target(look, look.shape) if wrong is None else [wrong]


# From which size on an error counts, in focal lengths. Chosen: 3 % of the focal length bend a wall
# tilted by 30 degrees by a centimetre at the border; 2 degrees of the principal point; 0.5 % at the
# corner bends it by 3 mm per metre.
_LEAST = {"focal length": 0.03, "principal point": 0.04, "distortion": 0.005}
_CAMERA = {
    "focal": ("focal length", "the focal length were {size:.0f} % {longer}"),
    "aspect": ("focal length", "the horizontal focal length alone were {size:.0f} % {longer}"),
    "centre": (
        "principal point",
        "the principal point lay {first:+z.0f} % of the focal length right, {second:+z.0f} % down",
    ),
    "corner": (
        "distortion",
        "the distortion moved the corners {size:.1f} % of the focal length {out}",
    ),
    "bend": (
        "distortion",
        "the image's axes were bent, its corners {first:+.1f} % of the focal length to the right "
        "and {second:+.1f} % further down, as by a wedge of glass or a tilted lens",
    ),
}
"""By estimate: the finding, and what would fit better."""


def _wrong_camera(found: dict[str, Estimate]) -> Finding | None:
    """Judge K and distortion by estimates of their errors, and say what is most surely wrong.

    What would change a focal length by all of itself is another mistake, such as a mirrored image.
    """
    surely = {
        name: one.size / one.size_error
        for name, (check, _) in _CAMERA.items()
        if 1 > (one := found[name]).size > max(_LEAST[check], SIGMAS * one.size_error)
    }
    if not surely:
        return None
    name = max(surely, key=surely.__getitem__)
    one, (check, words) = found[name], _CAMERA[name]
    first, second = 100 * one.value[0], 100 * one.value[-1]
    longer, out = ("longer", "out") if first > 0 else ("shorter", "in")
    better = words.format(size=abs(first), first=first, second=second, longer=longer, out=out)
    # With a quarter more it is another camera's.
    severity = "impossible" if name == "focal" and 4 * one.size > 1 else "doubtful"
    said = f"Walls fit better if {better} (standard error {100 * one.size_error:.1f} %)"
    ask = "are K and distortion of this camera, resolution and crop, and of images rectified or not"
    return Finding(severity, f"{said}: {ask}, as these are?", spoils=True, check=check)


def _target(look: Look, shape: dict[str, Estimate]) -> Iterator[Finding]:
    """Judge whether the target is bent, or its rim reads wrong, by what spoils a fit."""
    curved, rim = shape["curvature"], shape["rim"]
    places = np.hypot(*places_on_wall(look.of_camera))[look.of_camera.used]
    half_width = float(np.quantile(places, 0.9))
    sag, rising = np.abs(curved.value) * half_width**2, np.abs(rim.value)
    # Light that comes by another way comes later.
    (later,), problem = -shape["room"].value, look.of_camera
    typical = float(np.median((problem.distance**2 / np.abs(problem.cosine))[problem.used]))
    if ((rising > SPOILS) & (rising > SIGMAS * rim.error)).any():
        where = f"{1e3 * float(rising.max()):.0f} mm off at one end, from wherever it is seen"
        advice = "a second reflection? Mask it, unless runtime.second_bounces removes it"
        yield doubtful(f"The target lies {where}: {advice}.", check="rim")
    elif ((sag > SPOILS) & (sag > SIGMAS * curved.error * half_width**2)).any():
        where = f"{1e3 * float(sag.max()):.0f} mm within {half_width:.1f} m of its middle"
        said = f"The target is bent by {where}, from wherever it is seen"
        yield doubtful(f"{said}: use a flat one, or mask it.", spoils=True, check="target")
    elif later > max(SPOILS / typical, SIGMAS * shape["room"].size_error):
        off = f"{1e3 * later * typical:.0f} mm too far"
        said = f"The room lights the target too (multipath): it reads {off}"
        advice = "move it away from bright walls, or cover these"
        yield doubtful(f"{said}, more where far or tilted; {advice}.", check="room")


def drift(look: Look) -> Iterator[Finding]:
    """Do poses, wall and camera agree as well at the end of a recording as at its beginning?

    A camera that warms up shifts its distances alike, by about a centimetre. That is no fault, and
    what it explains is a note; 20 mm may be either.
    """
    found = look.drift
    if found is not None:
        # Frames miss their planes by a quarter of it in the middle of each half.
        size = f"{1e3 * found.size:.0f} mm (standard error {1e3 * found.size_error:.0f} mm)"
        said = f"From first to last frame the points move {size} off the recorded planes"
        moved = "the poses drift, or robot, target" if look.scene.moves else "target"
        cause = f"{moved} or camera was moved; record again, or in parts"
        severity = "impossible" if found.size > 4 * CAMERA else "doubtful"
        if found.size < CAMERA and pose_drift(look.of_camera, warming=True) is None:
            severity = "note"
            cause = "a camera that warms up" + ", or poses that drift" * look.scene.moves
        yield Finding(severity, f"{said}: {cause}.")


def late(look: Look) -> Iterator[Finding]:
    """Are a pose and its image of one moment, or does one hold a share of the frame before?"""
    if look.late is not None:
        (kind, of), share, found = look.late
        size = f"{1e3 * found.size:.1f} mm (standard error {1e3 * found.size_error:.1f} mm)"
        said = f"Each {kind} holds {100 * share:.1f} % of {of}, which moves points by {size}"
        cause = "the robot still moved, poses lag, or " * look.scene.moves
        cause += "the camera filters over time; wait after a move"
        yield doubtful(f"{said}: {cause}.", spoils=found.size > SPOILS)


def agreement(look: Look) -> Iterator[Finding]:
    """Do poses, planes and depth agree, and if not, which usual mistake explains it?

    Mistakes are undone where whole frames are 5 mm off their planes, and half of the flatness of
    the walls, since noise of the pixels moves planes as well: of 72 clean recordings the most had
    2.5 mm. It is doubtful if none explains that; where errors of the camera cannot be taken off, if
    they do not either.
    """
    given = look.as_given
    if given is None:
        return
    excess, fine = _excess(look), max(CAMERA / 2, look.flatness) / 2
    large = abs(given.constant) > LARGE_CONSTANT
    named: list[Explanation] = []
    if excess >= fine or large or abs(given.slope) > ODD_SLOPE:
        from tofcorr.plausibility.mistakes import best_explanations  # Of use to few recordings.

        named = best_explanations(look)
    if named:
        yield _explained(look, named)
    elif excess > (CAMERA if look.shape is None else fine):
        # A camera that moved on the tool explains it; by far, one fit to both parts is meaningless.
        moved = list(remounting(look))
        if given.badness > CAMERA:
            moved = [replace(one, severity="impossible") for one in moved if one.spoils]
        yield from moved or list(_wrapping(look)) or [_unexplained(look, excess)]
    else:
        yield from _scale(look)
        if large:
            said = f"The distances are {1e3 * given.constant:+.0f} mm off on the whole"
            yield note(f"{said}, much for a camera: are they of the target, and in metres?")


def _excess(look: Look) -> float:
    """Return how far frames are off their planes as wholes, metres.

    Root mean square over the frames that do not disagree with all others; where errors of the
    camera cannot be told, of the median frame, beyond the flatness of the walls.
    """
    if look.planes_off is None:
        return math.sqrt(max(float(np.median(look.rms)) ** 2 - look.flatness**2, 0.0))
    off = look.planes_off[~np.isin(look.frames, list(outlying_frames(look)))]
    return math.sqrt(float(np.nanmean(off**2))) if np.isfinite(off).any() else 0.0


def _explained(look: Look, named: "list[Explanation]") -> Finding:
    """Return what says which mistake it is.

    Where only the planes are wrong, a fit is meaningless if they are hopelessly off, or by 15
    degrees: planes a few degrees off are what `diagnose` finds as target_registration.
    """
    from tofcorr.plausibility.mistakes import WRONG_PLANES

    (cause, advice, found, frees), given = named[0], look.given
    # A mirrored image and a mirrored world look alike; say both.
    others = [more for more, other, _, freed in named if other != advice and not freed]
    also = f" (as likely: {others[0]})" if others and not frees else ""
    meaningless = given.badness > CAMERA
    if cause == WRONG_PLANES:
        meaningless = given.badness > HOPELESS or math.degrees(given.typical_angle) > 15
    undone = f"by {_mm(found.misfit)} if one mistake is undone: {cause}{also}; {advice}."
    severity = "impossible" if meaningless else "doubtful"
    return Finding(severity, f"{_misfit(look)}, and {undone}", spoils=True)


def _unexplained(look: Look, excess: float) -> Finding:
    """Return what says that no mistake explains the misfit."""
    known = look.planes == "known"
    hints = "; if nobody measured the planes, use `planes: unknown`" if known else ""
    # Without the frequency, waves of the circular error cannot be told from wrong poses.
    if look.recording.modulation_frequency is None:
        hints += "; state `modulation_frequency_hz` if you know it"
    far = int((look.rms > HOPELESS).sum())
    others = f", {far} of {len(look.rms)} frames more than {_mm(HOPELESS)}" if far else ""
    severity = "impossible" if excess > HOPELESS else "doubtful"
    said = f"{_misfit(look)}{others}, and no usual mistake explains it"
    what = "poses, planes or depth" if look.scene.moves else "planes or depth"
    cause = f"{what} are of something else, or scatter{hints}"
    return Finding(severity, f"{said}: {cause}.", spoils=excess > SPOILS)


def _misfit(look: Look) -> str:
    given, angle = look.given, math.degrees(look.given.typical_angle)
    turned = f" and {angle:.0f} degrees" if angle >= 2 else ""
    far = abs(given.constant) > LARGE_CONSTANT
    constant = f", with all distances {1e3 * given.constant:+.0f} mm off" if far else ""
    aligned = "After the best alignment of the camera the" if look.scene.moves else "The"
    lie = f"{aligned} points lie {_mm(given.misfit)}{turned} off"
    planes = "walls" if look.planes == "unknown" else "recorded planes"
    return f"{lie} the {planes}{constant}"


def _mm(metres: float) -> str:
    return f"{1e3 * metres:.0f} mm" if metres < 10 else f"{metres:.0f} m"


def _scale(look: Look) -> Iterator[Finding]:
    """Do robot and camera agree on lengths?

    Those of the robot count as true, see `ODD_SLOPE`. An error of 15 % is another unit. A
    difference of the hand-eye's length of 2 mm is worth a note: below, other errors are as large. A
    scale with a standard error above 0.5 % is not looked at.
    """
    given = look.given
    if 100 * abs(given.slope) > 15:
        said = f"All distances are {100 * given.slope:+.0f} % off against poses and planes"
        unit = "one of them is in another unit, or scaled"
        yield impossible(f"{said}: {unit}.", spoils=True, check="scale")
        return
    share, error = 0.0, math.inf
    if look.linear is not None and look.scene.moves:
        share, error = length_scale(given, look.linear)
    if 1000 * error > 5:
        share, error = given.slope, math.inf
    length = abs(share) * float(math.hypot(*given.hand_eye[:3, 3]))
    heads = abs(share) > ODD_SLOPE
    if not heads and not (1000 * length > 2 and abs(share) > SIGMAS * error):
        return
    uncertain = f" (standard error {100 * error:.2g} %)" if math.isfinite(error) else ""
    longer, short = ("longer", "short") if share > 0 else ("shorter", "long")
    said = f"The camera's distances are {100 * abs(share):.1f} %{uncertain} {longer} than"
    what, wrong = "planes", "a wrong board size looks the same"
    if look.scene.moves:
        what, wrong = "robot", f"if not, the hand-eye is {1e3 * length:.1f} mm too {short}"
    said = f"{said} those of the {what}, which count as true; {wrong}."
    yield Finding("ambiguous" if heads else "note", said, check="scale")


def outlying_poses(look: Look) -> Iterator[Finding]:
    """Does the pose or the plane of single frames disagree with all others?"""
    if off := outlying_frames(look):
        amounts = ", ".join(f"{1e3 * value:.0f}" for value in list(off.values())[:5])
        verb = "disagrees" if len(off) == 1 else "disagree"
        said = f"{in_words(tuple(off)).capitalize()} {verb} with all others by {amounts} mm"
        usual = f"median {1e3 * float(np.median(look.rms)):.0f} mm"
        why = "wrong poses, planes or images; train, evaluate and select leave them out"
        yield doubtful(f"{said} ({usual}): {why}.", tuple(off))


def outlying_frames(look: Look) -> dict[int, float]:
    """Return the misfit of every frame that disagrees with all others, metres, the worst first.

    A frame disagrees if its misfit is five times the median's, and what no error of a camera makes;
    twice that where these cannot be taken off first. More than three in ten are no single ones: the
    alignment is robust to so many. It takes three frames, so that one of six can disagree. A single
    ray has the noise of its amplitude, of which the typical frame has little.
    """
    if look.as_given is None or len(look.rms) < 6:
        return {}
    rms, limit = look.rms, (2 if look.shape is None else 1) * CAMERA
    expected = np.full(len(rms), max(5 * float(np.median(rms)), limit))
    if look.amplitude is not None and not look.scene.known.any():
        bright = np.nanmax(look.amplitude[look.usable], axis=1)
        expected *= np.maximum(np.median(bright) / np.maximum(bright, TINY), 1)
    off = np.flatnonzero(rms > expected)
    if 10 * len(off) > 3 * len(rms):
        return {}
    return {int(look.frames[k]): float(rms[k]) for k in off[np.argsort(-rms[off])]}
