"""Checks of values and images: units, repeated and missing values, still poses, two exposures."""

import math
from collections.abc import Iterator

import numpy as np

from tofcorr.geometry.rays import lens_misses
from tofcorr.plausibility.alignment import TINY, distinct
from tofcorr.plausibility.finding import Finding, doubtful, impossible, in_words, note
from tofcorr.plausibility.look import Look
from tofcorr.spread import sigma_from_mad

# Fewest values by which a distribution is judged. Chosen.
_FEWEST_VALUES = 50
# Share of one value from which it counts as a limit of the camera: clipped depth, saturated
# amplitude. Chosen.
_COMMON = 0.01


def units(
    look: Look,
    far: float = 20.0,
    too_far: float = 100.0,
    millimetres: float = 400.0,
    too_near: float = 0.005,
    too_wide: float = 50.0,
) -> Iterator[Finding]:
    """Are depth and poses in metres?

    Args:
        look: The recording.
        far: Median distance from which it is doubtful, metres: few cameras are 20 m from a wall.
        too_far: The same, impossible: none is.
        millimetres: From here on depth counts as millimetres, below as centimetres: 0.4 or 4 m.
        too_near: Median distance below which it is impossible: the shortest of any camera.
        too_wide: Largest distance of a pose from the middle of the poses: no arm reaches so far.
    """
    values = look.stored[np.isfinite(look.stored)]
    median = float(np.median(values)) if len(values) else 1.0
    if median > too_far:
        unit = "millimetres" if median > millimetres else "centimetres"
        yield impossible(
            f"The median distance is {median:.4g} m: depth.npy seems to be in {unit}, or to "
            "hold amplitudes; write metres."
        )
    elif median < too_near:
        yield impossible(
            f"The median distance is {1e3 * median:.3g} mm: depth.npy seems to be in "
            "kilometres, or scaled twice; write metres."
        )
    elif median > far:
        yield doubtful(
            f"The median distance is {median:.3g} m, far for a wall: is depth.npy in metres?"
        )
    place = look.poses[:, :3, 3]
    extent = float(np.linalg.norm(place - np.median(place, axis=0), axis=1).max())
    if extent > too_wide and look.planes != "ignored":
        yield impossible(
            f"The poses extend over {extent:.4g} m: tx, ty, tz in frames.csv seem to be in "
            "millimetres; write metres."
        )


def depth_values(look: Look, empty: float = 0.95, many: float = 0.5) -> Iterator[Finding]:
    """Does the depth hold measured values: neither constant, nor clipped, nor rounded, nor none?

    Args:
        look: The recording.
        empty: Share of an image's pixels without a return from which it counts as empty.
        many: Share of empty frames above which the recording is doubtful.
    """
    valid = np.isfinite(look.stored)
    values = look.stored[valid]
    if not len(values):
        yield impossible(
            "No pixel looked at holds a usable distance: depth.npy is NaN or zero there, "
            "saturated, or the mask is empty."
        )
        return
    missing = np.flatnonzero(valid.mean(1) < 1 - empty)
    if len(missing):
        frames = tuple(look.sampled[missing].tolist())
        yield Finding(
            "doubtful" if len(missing) > many * len(valid) else "note",
            f"Hardly any usable pixel is left in {in_words(frames)}: no return, saturated, or "
            "masked out.",
            frames,
        )
    if len(values) >= _FEWEST_VALUES:
        yield from _repeated_or_rounded(values)


def _repeated_or_rounded(
    values: np.ndarray,
    stuck: float = 0.9,
    commoner: float = 5.0,
    coarse: float = 0.004,
    too_coarse: float = 0.02,
    off_step: float = 0.05,
) -> Iterator[Finding]:
    """Judge how often values repeat.

    Args:
        values: Depth as stored, metres.
        stuck: Share of one value from which the depth is stuck: far above any measured wall.
        commoner: How much commoner than the twentieth commonest a limit is: rounded depth has many
            common values.
        coarse: Step of rounded depth that is worth a note, metres.
        too_coarse: The same, doubtful: a step of 20 mm adds 6 mm to the noise.
        off_step: How far a rounded value may be off a multiple of the step, steps.
    """
    distinct, count = np.unique(values, return_counts=True)
    order = np.argsort(-count)
    share, value = count[order[0]] / len(values), distinct[order[0]]
    if share >= stuck:
        yield impossible(
            f"{100 * share:.0f} % of the pixels hold exactly {value:.4g} m: the depth is stuck "
            "at one value; record again."
        )
        return
    common = count[order[min(20, len(order) - 1)]] / len(values)
    if share >= _COMMON and share >= commoner * common:
        yield doubtful(
            f"{100 * share:.1f} % of the pixels hold exactly {value:.4g} m: the depth is "
            "clipped, or the value stands for no return; write NaN there."
        )
        return
    step = float(np.diff(distinct).min()) if len(distinct) > 2 else 0.0
    if step >= coarse and np.abs(distinct / step - np.round(distinct / step)).max() <= off_step:
        yield Finding(
            "doubtful" if step >= too_coarse else "note",
            f"The depth comes in steps of {1e3 * step:.3g} mm: it was rounded; errors below that "
            "cannot be calibrated pixel by pixel.",
        )


def stillness(
    look: Look, fewest: int = 3, few: int = 8, change: float = 0.02, relative: float = 0.03
) -> Iterator[Finding]:
    """Do the poses move, and often enough?

    Args:
        look: The recording.
        fewest: Distinct poses below which no hand-eye transform is determined: six unknowns, three
            from each image of a wall.
        few: The same, rough: as many again for the camera's errors.
        change: How far the wall's distance may change between frames of one pose and plane, metres:
            warm-up and noise are below.
        relative: The same as a share of the distance.
    """
    if not look.fits or look.planes == "ignored":
        return
    poses = look.poses
    number = len(distinct(poses))
    if len(poses) < 2:
        yield impossible("The recording holds one frame; record more poses.")
    elif number == 1:
        planes = (np.asarray(look.column(name)) for name in ("normal_world", "offset"))
        if len(distinct(np.column_stack([*planes]))) == 1:
            yield _still(look, change, relative)
    elif number < fewest:
        yield impossible(
            f"The frames have {number} distinct poses; {fewest} at least are needed for a "
            "hand-eye transform."
        )
    elif number < few:
        yield doubtful(
            f"Only {number} distinct poses: hand-eye and errors can hardly be told apart; "
            f"record {few} or more, tilted and at several distances."
        )


def _still(look: Look, change: float, relative: float) -> Finding:
    """Judge a recording in which neither pose nor plane changes."""
    distance = look.scene.distance
    distance = np.nanmedian(distance, axis=1) if len(distance) else np.zeros(1)
    moved = float(np.ptp(distance))
    kind = "same" if look.data.moves else "identity"
    if moved > max(change, relative * float(np.median(distance))):
        return impossible(
            f"All poses are the {kind} and all frames have one plane, yet the wall's distance "
            f"changes by {1e3 * moved:.0f} mm: the robot's poses were not recorded; write "
            "world_from_tool of each frame, or the plane of each in the camera's frame."
        )
    return impossible(
        f"All poses are the {kind} and the wall stays where it is: one view determines neither "
        "distance errors nor a hand-eye transform; record other poses."
    )


def duplicates(
    look: Look, fewest: int = 12, many: float = 0.5, same: float = 1e-4
) -> Iterator[Finding]:
    """Does an image stand in the recording twice, bit by bit on a fixed grid?

    Args:
        look: The recording.
        fewest: Distinct values of an image for equality to mean anything: by chance, as many noisy
            pixels never agree.
        many: Share of the frames that are copies from which a fit is meaningless.
        same: How far the entries of equal poses may differ.
    """
    grid, poses = look.grid, look.poses
    first: dict[bytes, int] = {}
    copies = [
        (k, earlier)
        for k, image in enumerate(grid)
        if len(np.unique(image[np.isfinite(image) & (image > 0)])) >= fewest
        and (earlier := first.setdefault(image.tobytes(), k)) != k
    ]
    if not copies:
        return
    frames = tuple(look.sampled[[k for k, _ in copies]].tolist())
    moved = any(np.abs(poses[k] - poses[earlier]).max() > same for k, earlier in copies)
    meaningless = moved and look.fits and len(copies) > many * len(grid)
    cause = ": the frames were written twice"
    if moved:
        cause = ", with another pose: the camera hung or images were paired wrongly"
    yield Finding(
        "impossible" if meaningless else "doubtful",
        f"The depth of {in_words(frames)} repeats an earlier frame bit by bit{cause}; remove them.",
        frames,
    )


def stamps(look: Look) -> Iterator[Finding]:
    """Do the timestamps count up, in each recording?"""
    start = 0
    for recording in look.data.recordings:
        steps = np.diff(recording.frames.timestamp)
        back = start + 1 + np.flatnonzero(steps < 0)
        if len(back):
            yield doubtful(
                f"timestamp_s goes back {len(back)} times, first at frame {back[0]}: the rows are "
                "not in the order of time; check that images and poses are paired, and sort them.",
                tuple(back.tolist()),
            )
        elif len(steps) > 1 and not steps.any():
            yield note("timestamp_s is the same in all frames: nothing can be said of warm-up.")
        start += recording.num_frames


def amplitude(look: Look, constant: float = 1e-3, same: float = 0.999) -> Iterator[Finding]:
    """Is the amplitude one: neither constant, nor saturated unmarked, nor the depth again?

    Args:
        look: The recording.
        constant: Spread over median below which it counts as constant: the light falls with the
            square of the distance, and by a few percent over any image.
        same: Correlation of amplitude and distance above which one is taken for the other.
    """
    if look.amplitude is None:
        return
    usable = np.isfinite(look.amplitude) & np.isfinite(look.stored)
    values, depth = look.amplitude[usable], look.stored[usable]
    if len(values) < _FEWEST_VALUES:
        return
    low, median, high = np.quantile(values, [0.05, 0.5, 0.95])
    share = float((values >= values.max()).mean())
    if high - low <= constant * max(median, TINY):
        sentence = (
            f"The amplitude is {median:.4g} nearly everywhere: it was not measured; remove "
            "amplitude.npy, and use a model without an intensity term."
        )
    elif np.ptp(depth) > 0 and np.corrcoef(values, depth)[0, 1] > same:
        sentence = (
            "The amplitude follows the depth exactly: amplitude.npy seems to hold depth again."
        )
    elif share >= _COMMON:
        sentence = (
            f"{100 * share:.1f} % of the pixels have the largest amplitude, {values.max():.6g}: "
            "they are saturated and their depth is wrong; set saturation_amplitude in "
            "recording.yaml."
        )
    else:
        return
    yield doubtful(sentence)


def temperatures(look: Look, fewest: int = 10) -> Iterator[Finding]:
    """Does the camera's temperature change, where at least some frames state it?"""
    values = look.column("body_temperature")
    known = np.zeros(0) if values is None else values[np.isfinite(values)]
    if len(known) >= fewest and np.ptp(known) == 0:
        yield note(
            f"body_temperature_c is {known[0]:g} in all frames: the sensor was not read, or the "
            "camera was warm; temperature terms cannot be estimated."
        )


def lens(look: Look, no_ray: float = 0.5) -> Iterator[Finding]:
    """Does the lens model give every pixel a viewing ray?

    Args:
        look: The recording.
        no_ray: Distance from a pixel to the image of its own ray from which it has none, pixels:
            where there is one, it is found to 1e-6, and where there is none, it is many pixels off.
    """
    used = np.isfinite(look.stored)
    missed = lens_misses(look.recording.camera).reshape(-1).numpy() > no_ray
    share = float(missed[look.pixel][used].mean()) if used.any() else 0.0
    if share > 0:
        yield doubtful(
            f"About {100 * share:.2g} % of the pixels have no viewing ray: `distortion` in "
            "recording.yaml turns back before it reaches them, so their points are wrong whatever "
            "their depth. Mask them (mask.npy), or calibrate the lens with views of a board that "
            "reach the corners; the order is k1 k2 p1 p2 k3 k4 k5 k6."
        )


def exposure(
    look: Look,
    fewest: int = 10,
    fewest_of_one: int = 3,
    ratio: float = 2.0,
    clear: float = 8.0,
    changes: float = 0.25,
) -> Iterator[Finding]:
    """Do the frames have one exposure, where none was recorded?

    Compared is how bright each frame sees its target, distance and tilt taken off.

    Args:
        look: The recording.
        fewest: Frames of a target.
        fewest_of_one: And of each exposure.
        ratio: Least ratio of two exposures: they differ by whole stops.
        clear: How many times the spread within them it is, as logarithms; it was 20 times.
        changes: Least share of the frames at which the exposure is another one than before: of
            independent exposures half are; targets that only share a name come one after another.
    """
    times = look.column("integration_time")
    recorded = times is not None and np.isfinite(times).all() and np.ptp(times) > 0
    if look.amplitude is None or recorded:
        return
    level, targets = _brightness(look, look.amplitude), look.data.targets[look.frames]
    for name in np.unique(targets):
        own = np.flatnonzero((targets == name) & np.isfinite(level))
        groups = _two_groups(level[own]) if len(own) >= fewest else None
        if groups is None:
            continue
        brighter, apart, spread = groups
        in_any_order = (brighter[1:] != brighter[:-1]).mean() >= changes
        enough = min(brighter.sum(), (~brighter).sum()) >= fewest_of_one
        if enough and apart >= max(np.log(ratio), clear * spread) and in_any_order:
            frames = tuple(look.frames[own[brighter]].tolist())
            yield doubtful(
                f"{in_words(frames).capitalize()} see {name} {np.exp(apart):.1f} times as bright "
                "as the others do: frames of two exposures, whose distances may differ; record "
                "integration_time_us, or train them apart.",
                frames,
            )
            return


def _brightness(look: Look, amplitude: np.ndarray, brightest: float = 0.1) -> np.ndarray:
    """Return the logarithm of how bright each frame is at 1 m and head on, shape (N,).

    That of its brightest tenth: nearly every view of a board shows a bright square.
    """
    scene, amplitude = look.scene, amplitude[look.usable]
    cosine = np.abs(np.einsum("fpa,fa->fp", scene.rays, np.nan_to_num(scene.own_normal)))
    used = scene.on_plane & np.isfinite(amplitude) & (cosine > 0)
    seen = np.where(used, amplitude * scene.distance**2 / np.maximum(cosine, TINY), 0.0)
    tenth = (brightest * used.sum(1)).astype(int)
    level = np.sort(seen, axis=1)[:, ::-1][np.arange(len(seen)), tenth]
    return np.where(scene.known & (tenth > 0), np.log(np.maximum(level, TINY)), np.nan)


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


def two_cameras(
    look: Look, fewest: int = 16, smaller: float = 0.25, agree: float = 0.95, apart: float = 2.5
) -> Iterator[Finding]:
    """Is the pattern of the pixels the same in all frames?

    A moment is looked for at which the pattern changed, then two patterns in any order.

    Args:
        look: The recording.
        fewest: Frames from which two patterns are told apart.
        smaller: Least share of frames that may come from another camera.
        agree: Share of frames on which both halves of the pixels must agree.
        apart: Least distance of two patterns over their full width: one normal cloud cut in two
            has 1.3.
    """
    # Repeats of a pose show the same, whatever it is.
    moves = look.data.moves
    chosen = distinct(look.scene.poses) if moves else np.arange(len(look.frames))
    pattern = _patterns(look, chosen)
    if pattern is None or len(pattern) < fewest:
        return
    moment = _moment(pattern, max(fewest // 2, math.ceil(smaller * len(pattern))))
    group = chosen[moment:]
    if moment is None:
        halves = []
        for half in (0, 1):
            centred = pattern[:, half::2] - pattern[:, half::2].mean(0)
            groups = _two_groups(centred @ np.linalg.svd(centred, full_matrices=False)[2][0])
            if groups is None or groups[1] <= 2 * apart * groups[2]:
                return
            halves.append(groups[0])
        one, other = halves
        if not smaller <= one.mean() <= 1 - smaller or agree > max(
            (one == other).mean(), (one != other).mean()
        ):
            return
        group = chosen[one == one[-1]]
    frames = look.frames[group]
    yield doubtful(
        f"The pattern of the pixels' errors is another one in {len(frames)} of {len(chosen)} "
        f"frames, from frame {int(frames.min())} on: frames of two cameras, or of two settings of "
        "one; train them apart.",
        spoils=True,
    )


def _patterns(
    look: Look, chosen: np.ndarray, fewest: int = 60, cut: float = 3
) -> np.ndarray | None:
    """Return the frames' residuals to their own planes without smooth parts, shape (F, P).

    None where the frames do not share enough pixels. Residuals are cut at `cut` robust standard
    deviations.
    """
    pixel, residual = look.pixel[look.usable][chosen], look.scene.off_by[chosen]
    if not len(pixel) or not (pixel == pixel[:1]).all():
        return None
    complete = np.isfinite(residual).mean(0) > 0.9
    if complete.sum() < fewest:
        return None
    residual = residual[:, complete]
    residual[np.isnan(residual).all(1)] = 0.0  # A frame without a plane says nothing.
    rays = look.scene.rays[chosen[0], complete]
    x, y = rays[:, 0] / rays[:, 2], rays[:, 1] / rays[:, 2]
    smooth = np.stack([x**i * y**j for i in range(4) for j in range(4 - i)], axis=1)
    spread = sigma_from_mad(np.nanmedian(np.abs(residual), axis=1, keepdims=True))
    kept = np.nan_to_num(np.clip(residual, -cut * spread, cut * spread))
    basis = np.linalg.qr(smooth)[0]
    return kept - (kept @ basis) @ basis.T


def _moment(
    pattern: np.ndarray,
    fewest: int,
    correlated: float = 0.55,
    by_chance: float = 5.0,
    least: float = 1e-3,
    moments: int = 41,
) -> int | None:
    """Return the frame at which the pattern changed for good; None: it did not.

    The change is measured twice, by even and by odd frames. Their noise is independent: what both
    see in the same pixels is a change.

    Args:
        pattern: Shape (F, P), metres.
        fewest: Frames before and after.
        correlated: Correlation of the two, at the least. In 12 recordings of two cameras it was
            0.76 to 0.84, in 51 clean ones at most 0.32.
        by_chance: With few pixels chance makes more: so many times 1 / sqrt(P).
        least: Change of a pixel, metres, root mean square: the patterns of two cameras differ by
            more, and a smaller one moves no plane.
        moments: How many are tried, at most: a change is seen from any that is off by a fortieth.
    """
    number, pixels = pattern.shape
    best, found = max(correlated, by_chance / math.sqrt(pixels)), None
    tried = np.unique(np.linspace(fewest, number - fewest, moments).astype(int))
    for moment in tried if number >= 2 * fewest else ():
        one, other = (
            pattern[moment:][half::2].mean(0) - pattern[:moment][half::2].mean(0) for half in (0, 1)
        )
        both = float(one @ other)
        correlation = both / max(math.sqrt(float((one @ one) * (other @ other))), TINY)
        if correlation > best and both > pixels * least**2:
            best, found = correlation, int(moment)
    return found
