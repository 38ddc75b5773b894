"""Checks of values and images: units, repeated and missing values, still poses, two exposures."""

import math
from collections.abc import Iterator

import numpy as np

from tofcorr.estimation.robust import sigma_from_mad
from tofcorr.geometry.rays import lens_misses
from tofcorr.plausibility.alignment import TINY, distinct
from tofcorr.plausibility.finding import (
    CAMERA,
    FEWEST_PIXELS,
    SIGMAS,
    WORTH_A_WORD,
    Finding,
    doubtful,
    impossible,
    in_words,
    note,
)
from tofcorr.plausibility.look import Look

# Percent of one value from which it counts as a limit of the camera: clipped depth, saturated
# amplitude. Chosen.
_COMMON = 1


def units(look: Look) -> Iterator[Finding]:
    """Are depth and poses in metres?

    Few cameras are 20 m from a wall, none is 100 m or less than 5 mm from it, and no arm reaches 50
    m. Up to 2000, which are 2 or 20 m, depth may be in millimetres or in centimetres.
    """
    values = look.stored[np.isfinite(look.stored)]
    median = float(np.median(values)) if len(values) else 1.0
    far = f"The median distance is {median:.4g} m"
    seems = f"{far}: depth.npy seems to be in"
    if median > 100:
        unit = "millimetres" if median > 2000 else "millimetres or centimetres"
        yield impossible(f"{seems} {unit}, or to hold amplitudes; write metres.")
    elif 1000 * median < 5:
        yield impossible(f"{seems} kilometres, or scaled twice; write metres.")
    elif median > 20:
        yield doubtful(f"{far}, much for a wall: is depth.npy in metres?")
    place = look.poses[:, :3, 3]
    extent = float(np.linalg.norm(place - np.median(place, axis=0), axis=1).max())
    if extent > 50 and look.planes != "ignored":
        said = "tx, ty, tz in frames.csv seem to be in millimetres; write metres"
        yield impossible(f"The poses extend over {extent:.4g} m: {said}.")


def corrected(look: Look) -> Iterator[Finding]:
    """Is the depth as the camera measured it?"""
    for by in sorted({one.corrected_by or "" for one in look.data.recordings} - {""}):
        said = f"The depth of a recording was corrected already, by {by}"
        yield doubtful(f"{said}: what is fitted to it holds for corrected frames alone.")


def depth_values(look: Look) -> Iterator[Finding]:
    """Does the depth hold measured values: neither constant, nor clipped, nor rounded, nor none?

    An image counts as empty if one pixel in twenty has a return, at the most. A recording is
    doubtful if most of its frames are empty.
    """
    valid = np.isfinite(look.stored)
    values = look.stored[valid]
    if not len(values):
        why = "depth.npy is NaN or zero there, saturated, or the mask is empty"
        yield impossible(f"No pixel looked at holds a usable distance: {why}.")
        return
    missing = np.flatnonzero(20 * valid.mean(1) < 1)
    if len(missing):
        frames = tuple(look.sampled[missing].tolist())
        severity = "doubtful" if 2 * len(missing) > len(valid) else "note"
        said = f"Hardly any usable pixel is left in {in_words(frames)}"
        yield Finding(severity, f"{said}: no return, saturated, or masked out.", frames)
    levels, count = np.unique(values, return_counts=True)
    at_top, below = (look.stored == levels[-1]).any(1), count[-21:-1]
    # Rounded distances repeat as well: of three that fall into 20 steps, one triple in 400 shares
    # the last. Repeats of the farthest pose count once.
    if len(np.unique(look.group[at_top])) > 2 < below.sum() and count[-1] >= 3 * below.mean():
        frames = tuple(look.sampled[at_top].tolist())
        said = f"{count[-1]} pixels of {in_words(frames)} hold exactly the largest distance"
        yield doubtful(f"{said}, {levels[-1]:.4g} m: the range ends there; write NaN.", frames)
    elif len(values) >= FEWEST_PIXELS:
        yield from _repeated_or_rounded(values)


def repeats(look: Look) -> Iterator[Finding]:
    """Do frames of one pose show the same distance, as those of other poses do?

    Ten times what they differ by elsewhere, and more than errors of a camera, is no noise.
    """
    distance, group = look.scene.distance, look.group[look.usable]
    # Pixel by pixel: on a steep wall the middle of all pixels moves with one that is missing.
    pairs = zip(distance, group, strict=True)
    moved = (np.nanmedian(distance[group == own] - one, axis=1) for one, own in pairs)
    apart = np.array([np.abs(each).max() for each in moved])
    typical = float(np.median(apart[apart > 0])) if apart.any() else 0.0
    if frames := tuple(look.frames[apart > max(CAMERA, 10 * typical)].tolist()):
        said = f"{in_words(frames).capitalize()} differ by {1e3 * apart.max():.0f} mm within a pose"
        yield doubtful(f"{said}, others by {1e3 * typical:.1f} mm: leave them out.", frames)


def _repeated_or_rounded(values: np.ndarray) -> Iterator[Finding]:
    """Judge how often values repeat: depth as stored, metres.

    A value that nine in ten pixels hold is far above any measured wall. A limit is five times as
    common as the twentieth commonest value: rounded depth has many common values. Rounding by 4 mm
    is worth a note; by 20 mm, which adds 6 mm to the noise, it is doubtful.
    """
    distinct, count = np.unique(values, return_counts=True)
    order = np.argsort(-count)
    percent, value = 100 * count[order[0]] / len(values), distinct[order[0]]
    common = 100 * count[order[min(20, len(order) - 1)]] / len(values)
    step = 1e3 * float(np.diff(distinct).min()) if len(distinct) > 2 else 0.0
    held = f"{percent:.1f} % of the pixels hold exactly {value:.4g} m: the depth is"
    steps = 1e3 * distinct / (step or 1.0)
    if percent >= 90:
        yield impossible(f"{held} stuck at one value; record again.")
    elif percent >= max(_COMMON, 5 * common):
        yield doubtful(f"{held} clipped, or the value stands for no return; write NaN there.")
    elif step >= 4 and np.abs(steps - np.round(steps)).max() < 1 / 20:
        lost = "it was rounded; errors below that cannot be calibrated pixel by pixel"
        severity = "doubtful" if step >= 20 else "note"
        yield Finding(severity, f"The depth comes in steps of {step:.3g} mm: {lost}.")


def stillness(look: Look) -> Iterator[Finding]:
    """Do the poses move, and often enough?

    Two poses determine the six unknowns of the hand-eye transform, three from each image of a wall,
    with nothing left to judge them by. Eight leave as many again for the camera's errors.
    """
    if not look.fits or look.planes == "ignored":
        return
    number = len(distinct(look.poses))
    if len(look.poses) < 2:
        yield impossible("The recording holds one frame; record more poses.")
    elif number == 1:
        planes = (look.data.column(one).numpy()[look.sampled] for one in ("normal_world", "offset"))
        if len(distinct(np.column_stack([*planes]))) == 1:
            yield _still(look)
    elif number < 3:
        yield impossible(f"Only {number} distinct poses; a hand-eye transform needs 3 at least.")
    elif number < 8:
        advice = "record 8 or more, tilted and at several distances"
        told = "hand-eye and errors can hardly be told apart"
        yield doubtful(f"Only {number} distinct poses: {told}; {advice}.")


def _still(look: Look) -> Finding:
    """Judge a recording in which neither pose nor plane changes.

    Warm-up and noise change the wall's distance by less than 3 %, and than a camera's errors.
    """
    distance = look.scene.distance
    distance = np.nanmedian(distance, axis=1) if len(distance) else np.zeros(1)
    moved = float(np.ptp(distance))
    told = "one view determines neither distance errors nor a hand-eye transform"
    rest = f"the wall stays where it is: {told}; record other poses"
    if moved > CAMERA and 100 * moved > 3 * float(np.median(distance)):
        yet = f"yet the wall's distance changes by {1e3 * moved:.0f} mm"
        advice = "write world_from_tool of each frame, or the plane of each in the camera's frame"
        rest = f"all planes one, {yet}: the robot's poses were not recorded; {advice}"
    return impossible(f"All poses are the {'same' if look.data.moves else 'identity'} and {rest}.")


def duplicates(look: Look) -> Iterator[Finding]:
    """Does an image stand in the recording twice, bit by bit in the pixels looked at?

    By chance, a dozen distinct noisy values never agree. If most frames are copies with other
    poses, a fit is meaningless.
    """
    images = [row.tobytes() for row in look.stored]
    telling = [len(np.unique(row[np.isfinite(row)])) >= 12 for row in look.stored]
    copies = [k for k, one in enumerate(images) if telling[k] and images.index(one) != k]
    if not copies:
        return
    frames = tuple(look.sampled[copies].tolist())
    pairs = ([k, images.index(images[k])] for k in copies)
    moved = any(len(distinct(look.poses[both])) > 1 for both in pairs)
    meaningless = moved and look.fits and 2 * len(copies) > len(images)
    cause = ", with another pose: the camera hung or images were paired wrongly"
    cause = cause if moved else ": the frames were written twice"
    said = f"The depth of {in_words(frames)} repeats an earlier frame bit by bit{cause}"
    yield Finding("impossible" if meaningless else "doubtful", f"{said}; remove them.", frames)


def stamps(look: Look) -> Iterator[Finding]:
    """Do the timestamps count up, in each recording?"""
    start = 0
    for recording in look.data.recordings:
        steps = np.diff(recording.frames.timestamp)
        back = start + 1 + np.flatnonzero(steps < 0)
        if len(back):
            said = f"timestamp_s goes back {len(back)} times, first at frame {back[0]}"
            advice = "check that images and poses are paired, and sort them by time"
            yield doubtful(f"{said}: {advice}.", tuple(back.tolist()))
        elif len(steps) > 1 and not steps.any():
            yield note("timestamp_s is the same in all frames: nothing can be said of warm-up.")
        start += recording.num_frames


def amplitude(look: Look) -> Iterator[Finding]:
    """Is the amplitude one: neither constant, nor saturated unmarked, nor the depth again?

    It is constant if it spreads by less than a thousandth: light falls with the square of the
    distance, and by a few percent over any image.
    """
    if look.amplitude is None:
        return
    usable = np.isfinite(look.amplitude) & np.isfinite(look.stored)
    values, depth = look.amplitude[usable], look.stored[usable]
    if len(values) < FEWEST_PIXELS:
        return
    median = np.median(values)
    spread = sigma_from_mad(np.median(np.abs(values - median)))
    percent = 100 * float((values >= values.max()).mean())
    if 1000 * spread <= max(median, TINY):
        advice = "remove amplitude.npy, and use a model without an intensity term"
        said = f"The amplitude is {median:.4g} nearly everywhere"
        yield doubtful(f"{said}: it was not measured; {advice}.")
    elif np.ptp(depth) > 0 and 1000 * np.corrcoef(values, depth)[0, 1] > 999:
        yield doubtful("The amplitude follows the depth exactly: is amplitude.npy depth again?")
    elif percent >= _COMMON:
        said = f"{percent:.1f} % of the pixels have the largest amplitude, {values.max():.6g}"
        wrong = "they are saturated, their depth is wrong"
        yield doubtful(f"{said}: {wrong}; set saturation_amplitude in recording.yaml.")
    else:
        yield from _of_the_depth(look, look.amplitude[look.usable])


# Share of the depth's relative noise (no unit) from which on an amplitude was computed from it:
# half of what 1 / depth has. 30 clean recordings had 0.11 at most.
_OF_DEPTH = 0.5


def _of_the_depth(look: Look, amplitude: np.ndarray) -> Iterator[Finding]:
    """Is it the light that measured the depth, with noise of its own?

    That light falls with the square of the distance and with the cosine of incidence, beside
    squares and the fall-off of a lens. The noise of a phase is independent of the amplitude's; an
    amplitude divided by the square of the measured distance has twice its relative noise, with the
    other sign. It is looked for where no edges of squares are seen.
    """
    scene, changing = look.scene, np.ptp(look.condition("integration_time")) > 0
    with np.errstate(divide="ignore", invalid="ignore"):
        bright, far = np.log(amplitude), np.log(np.abs(scene.cosine) / scene.distance**2)
    used = scene.on_plane & np.isfinite(bright + far)
    count = np.maximum(used.sum(1, keepdims=True), 1)
    x, y = (np.where(used, one / count, 0.0).sum(1, keepdims=True) for one in (far, bright))
    slope, error = _slope(x, y, used.any(1, keepdims=True))
    if not changing and 3 * abs(slope - 1) > max(2, 3 * SIGMAS * error):
        said = f"The amplitude falls with the distance to the power of {2 * slope:.1f}"
        cause = f"light with that of 2 (standard error {2 * error:.1g})"
        yield note(f"{said}, {cause}: is it another camera's, or has each frame its own exposure?")
    relative = scene.off_by / scene.distance
    bright, deep = (_rough(one, scene.rays, used) for one in (bright, relative))
    used &= (np.square(bright).sum(1) < used.sum(1) / 100)[:, None]
    slope, error = _slope(deep, bright, used)
    if slope < -max(_OF_DEPTH, SIGMAS * error):
        said = f"The amplitude has {slope:.2f} times the relative noise of the depth"
        how = "(-1: divided by it, -2: by its square)"
        cause = f"it was computed from the depth {how}; use the camera's own"
        yield doubtful(f"{said} (standard error {error:.1g}): {cause}.")


def _slope(x: np.ndarray, y: np.ndarray, used: np.ndarray) -> tuple[float, float]:
    """Return the slope of y over x, all (F, P), and its standard error by frames."""
    x, y = (np.where(used, one - one[used].sum() / max(used.sum(), 1), 0.0) for one in (x, y))
    square = max(float((x * x).sum()), TINY)
    slope = float((x * y).sum()) / square
    error = float(np.linalg.norm((x * (y - slope * x)).sum(1))) / square
    return slope, error if used.any(1).sum() > 8 else math.inf  # Hardly known of fewer frames.


def temperatures(look: Look) -> Iterator[Finding]:
    """Does the camera's temperature change, where at least some frames state it?"""
    values = look.condition("body_temperature")
    known = values[np.isfinite(values)]
    if len(known) >= 10 and np.ptp(known) == 0:
        said = f"body_temperature_c is {known[0]:g} in all frames"
        yield note(f"{said}: not read, or the camera was warm; no temperature term can be fitted.")


def lens(look: Look) -> Iterator[Finding]:
    """Does the lens model give every pixel a viewing ray?

    Where there is one, its image is found to 1e-6 pixels, and else it is many pixels off.
    """
    used = np.isfinite(look.stored)
    missed = lens_misses(look.recording.camera).reshape(-1).numpy() > 0.5
    share = float(missed[look.pixel][used].mean()) if used.any() else 0.0
    if share > 0:
        turned = "`distortion` in recording.yaml turns back before it reaches them"
        said = f"About {100 * share:.2g} % of the pixels have no viewing ray: {turned}"
        views = "the lens with views of a board that reach the corners; the order is"
        advice = f"Mask them (mask.npy), or calibrate {views} k1 k2 p1 p2 k3 k4 k5 k6"
        yield doubtful(f"{said}. {advice}.")


# Frames differ by so much in brightness only if their amplitudes are in two units: the brightest
# surface returns thirty times the light of the darkest, and exposures go from 1 to 10.
_TWO_UNITS = 300


def exposure(look: Look) -> Iterator[Finding]:
    """Are the amplitudes in one unit, and do the frames have one exposure, where none was recorded?

    Compared is how bright each frame sees its target, distance and tilt taken off. Two exposures of
    at least three frames each differ by a stop or more, and by eight times the spread within them,
    as logarithms; it was 20 times. At half of the frames an independent exposure is another one
    than before, at a quarter it must be: targets that only share a name come one after another.
    Of a target with dark and bright parts only frames that show both are compared.
    """
    if look.amplitude is None:
        return
    level, contrast = _brightness(look, look.amplitude)
    seen = np.flatnonzero(np.isfinite(level))
    off = level[seen] - np.sort(level[seen])[len(seen) // 2 : len(seen) // 2 + 1]
    if len(odd := seen[np.abs(off) > np.log(_TWO_UNITS)]):
        frames, most = tuple(look.frames[odd].tolist()), np.exp(off[np.abs(off).argmax()])
        said = f"{in_words(frames).capitalize()} see their targets up to {most:.3g} times as bright"
        yield doubtful(f"{said} as the others do: amplitudes in two units; write one.", frames)
        return
    times, targets = look.condition("integration_time"), look.data.targets[look.frames]
    if np.isfinite(times).all() and np.ptp(times) > 0:
        return
    for name in np.unique(targets):
        own = np.flatnonzero((targets == name) & np.isfinite(level))
        own = own[2 * contrast[own] >= contrast[own].max(initial=0.0)]
        groups = _two_groups(level[own]) if len(own) >= 10 else None
        if groups is None:
            continue
        brighter, apart, spread = groups
        in_any_order = 4 * (brighter[1:] != brighter[:-1]).mean() >= 1
        enough = min(brighter.sum(), (~brighter).sum()) >= 3
        if enough and apart >= max(np.log(2), 8 * spread) and in_any_order:
            frames = tuple(look.frames[own[brighter]].tolist())
            said = f"{in_words(frames).capitalize()} see {name} {np.exp(apart):.1f} times as bright"
            differ = "frames of two exposures, whose distances may differ"
            advice = "record integration_time_us, or train them apart"
            yield doubtful(f"{said} as the others do: {differ}; {advice}.", frames)
            return


def _brightness(look: Look, amplitude: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return how bright each frame is at 1 m and head on, and its contrast, shape (N,) each.

    Both as logarithms: of its brightest tenth, as nearly every view of a board shows a bright
    square, and of that over its darkest tenth.
    """
    scene, amplitude = look.scene, amplitude[look.usable]
    cosine = np.abs(scene.cosine)
    used = scene.on_plane & np.isfinite(amplitude) & (100 * cosine > 1)
    seen = amplitude * scene.distance**2 / np.where(used, cosine, 1.0)
    seen = np.sort(np.where(used, seen, np.nan), axis=1)  # NaN comes last.
    count, each, tenth = used.sum(1), np.arange(len(seen)), used.sum(1) // 10
    dark, bright = (np.log(np.maximum(seen[each, k], TINY)) for k in (tenth, count - 1 - tenth))
    unknown = ~scene.known | (tenth < 1) | (bright <= np.log(TINY))
    return np.where(unknown, np.nan, bright), np.where(unknown, np.nan, bright - dark)


def _two_groups(score: np.ndarray) -> tuple[np.ndarray, float, float] | None:
    """Part numbers (F,) where they are farthest apart; None: there is one group.

    Returns:
        Which are high, (F,) bool; the distance of the groups' means; the standard deviation within.
    """
    high = score > np.median(score)
    for _ in range(20):
        if high.all() or not high.any():
            return None
        high = score > (score[high].mean() + score[~high].mean()) / 2
    spread = np.sqrt((score[high].var() + score[~high].var()) / 2)
    return high, float(score[high].mean() - score[~high].mean()), float(spread)


def two_cameras(look: Look) -> Iterator[Finding]:
    """Is the pattern of the pixels the same in all frames?

    A moment is looked for at which the pattern changed, then two patterns in any order: on these,
    both halves of the pixels must agree in 19 frames of 20. From another camera come a quarter of
    the frames or more. Two patterns are five standard deviations apart: one normal cloud cut in two
    has 2.6.
    """
    # Repeats of a pose show the same, whatever it is.
    chosen = distinct(look.scene.poses) if look.data.moves else np.arange(len(look.frames))
    pattern = _patterns(look, chosen)
    if pattern is None or len(pattern) < 16:
        return
    moment = _moment(pattern, max(8, math.ceil(len(pattern) / 4)))
    group = chosen[moment:]
    if moment is None:
        halves = []
        for half in (0, 1):
            centred = pattern[:, half::2] - pattern[:, half::2].mean(0)
            groups = _two_groups(centred @ np.linalg.svd(centred, full_matrices=False)[2][0])
            if groups is None or groups[1] <= 5 * groups[2]:
                return
            halves.append(groups[0])
        one, other = halves
        agreeing = (one == other).mean()
        if not 1 <= 4 * one.mean() <= 3 or 20 * max(agreeing, 1 - agreeing) < 19:
            return
        group = chosen[one == one[-1]]
    frames = look.frames[group]
    where = f"{len(frames)} of {len(chosen)} frames, from frame {int(frames.min())} on"
    cause = "frames of two cameras, or of two settings of one; train them apart"
    said = f"The pattern of the pixels' errors is another one in {where}: {cause}."
    yield doubtful(said, spoils=True)


def _patterns(look: Look, chosen: np.ndarray) -> np.ndarray | None:
    """Return the frames' residuals to their own planes without smooth parts, shape (F, P).

    None where the frames do not share 60 pixels. Residuals are cut at three robust standard
    deviations.
    """
    pixel, residual = look.pixel[look.usable][chosen], look.scene.off_by[chosen]
    if not len(pixel) or not (pixel == pixel[:1]).all():
        return None
    complete = 10 * np.isfinite(residual).mean(0) > 9
    if complete.sum() < 60:
        return None
    residual = residual[:, complete]
    residual[np.isnan(residual).all(1)] = 0.0  # A frame without a plane says nothing.
    cut = 3 * sigma_from_mad(np.nanmedian(np.abs(residual), axis=1, keepdims=True))
    kept = np.nan_to_num(np.clip(residual, -cut, cut))
    return _rough(kept, look.scene.rays[chosen[:1]][:, complete], np.ones((1, complete.sum())) > 0)


def _rough(values: np.ndarray, rays: np.ndarray, used: np.ndarray) -> np.ndarray:
    """Return values (F, P) less a cubic over the image; zero where they are not used."""
    x, y = rays[..., 0] / rays[..., 2], rays[..., 1] / rays[..., 2]
    powers = [x**i * y**j for i in range(4) for j in range(4 - i)]
    smooth = np.stack(powers, axis=-1) * used[..., None]
    kept = np.where(used, values, 0.0)[..., None]
    return (kept - smooth @ (np.linalg.pinv(smooth) @ kept))[..., 0]


def _moment(pattern: np.ndarray, fewest: int) -> int | None:
    """Return the frame at which the pattern changed for good; None: it did not.

    The change is measured twice, by even and by odd frames. Their noise is independent: what both
    see in the same pixels is a change. Patterns of two cameras differ by more than a millimetre,
    root mean square, and a smaller change moves no plane. Of 41 moments, one is off by a fortieth.

    Args:
        pattern: Shape (F, P), metres.
        fewest: Frames before and after.
    """
    number, pixels = pattern.shape
    # In 12 recordings of two cameras the correlation was 0.76 to 0.84, in 51 clean ones at most
    # 0.32. With few pixels chance makes more.
    best, found = max(55, 500 / math.sqrt(pixels)), None
    tried = np.unique(np.linspace(fewest, number - fewest, 41).astype(int))
    for moment in tried if number >= 2 * fewest else ():
        one, other = (
            pattern[moment:][half::2].mean(0) - pattern[:moment][half::2].mean(0) for half in (0, 1)
        )
        both = float(one @ other)
        correlation = 100 * both / max(math.sqrt(float((one @ one) * (other @ other))), TINY)
        if correlation > best and both > pixels * WORTH_A_WORD**2:
            best, found = correlation, int(moment)
    return found
