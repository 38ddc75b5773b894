"""Has the image the K and the distortion, and the depth the kind, that the header says?"""

import numpy as np

from tofcorr.plausibility.finding import Finding
from tofcorr.plausibility.image_shape import Estimate, ImageShape
from tofcorr.plausibility.look import Look

# An estimate counts from so many of its standard errors on. Chosen: of 560 estimates in 62 clean
# recordings none reached four (benchmarks/faults_in_recordings.py).
_SIGMAS = 5.0
# Error of the focal length that counts, of one against the other, and that makes a fit meaningless,
# without unit. Chosen: 3 % bends a wall tilted by 30 degrees by a centimetre at the border.
_FOCAL, _OTHER_CAMERA = 0.03, 0.25
# Shift of the principal point that counts, in focal lengths. Chosen: 2 degrees.
_CENTRE = 0.04
# Shift of the image's corner by the distortion, or by bent axes, that counts, in focal lengths.
# Chosen: where a wall is tilted by 30 degrees, it bends it by 3 mm per metre.
_CORNER = 0.005
# Largest standard error at which an estimate of K, and of the kind, is looked at. Chosen.
_CAMERA_SE, _KIND_SE = 0.03, 0.1
# Departure of the target from a plane that counts, metres. Chosen: as large as what is calibrated.
_SAG = 0.01
# Distance of the frames to their planes above which poses or planes are wrong, and shape cannot be
# told, metres. Chosen.
_FAR_OFF = 0.03
# The kind counts as the other one from here on; 1 would be exactly. Chosen: midway.
_OTHER = 0.5


def check(look: Look) -> list[Finding]:
    """Look at the estimates of `image_shape`, unless frames are far off whatever the shape."""
    shape = look.shape
    if shape is None or float(np.median(shape.rms)) > _FAR_OFF:
        return []
    for found in (_kind(look, shape), _of_camera(shape), _curved(shape)):
        if found is not None:
            return [found]
    return []


def _kind(look: Look, shape: ImageShape) -> Finding | None:
    declared = look.sample.recording.depth_kind
    other = "z" if declared == "radial" else "radial"
    share, error = float(shape.kind.value[0]), shape.kind.size_error
    if error >= _KIND_SE or not _OTHER < share < 1 + _OTHER:
        return None
    return Finding(
        "kind",
        "impossible",
        f"recording.yaml says depth_kind: {declared}, but walls are bent as if the depth were "
        f"{other} ({100 * share:.0f} % of the difference, standard error {100 * error:.0f} %); "
        f"write depth_kind: {other}.",
    )


def _of_camera(shape: ImageShape) -> Finding | None:
    """Judge K and distortion, and say what is most surely wrong."""
    judged = (
        ("focal length", shape.focal, _FOCAL),
        ("focal length", shape.aspect, _FOCAL),
        ("principal point", shape.centre, _CENTRE),
        ("distortion", shape.corner, _CORNER),
        ("distortion", shape.bend, _CORNER),
    )
    wrong = [one for one in judged if _counts(one[1], one[2])]
    if not wrong:
        return None
    check, estimate, _ = max(wrong, key=lambda one: one[1].size / one[1].size_error)
    return Finding(
        check,
        "impossible" if estimate is shape.focal and estimate.size > _OTHER_CAMERA else "doubtful",
        f"{_better(shape, estimate)} (standard error {100 * estimate.size_error:.1f} %): are K and "
        "distortion of this camera, of this resolution and crop, and of images as they are here, "
        "rectified or not?",
        spoils=True,
    )


def _better(shape: ImageShape, estimate: Estimate) -> str:
    """Return what would fit better."""
    first = 100 * float(estimate.value[0])
    size, more, further = abs(first), "longer" if first > 0 else "shorter", first > 0
    if estimate is shape.focal:
        return f"Walls fit better if the focal length were {size:.0f} % {more}"
    if estimate is shape.aspect:
        return (
            f"Walls fit better if the horizontal focal length were {size:.0f} % {more}, the "
            "vertical one as it is"
        )
    if estimate is shape.corner:
        return (
            f"Walls fit better if the distortion moved the corners of the image {size:.1f} % of "
            f"the focal length further {'out' if further else 'in'}"
        )
    down = 100 * float(estimate.value[1])
    if estimate is shape.bend:
        return (
            f"Walls fit better if the image's axes were bent, its corners {first:+.1f} % of the "
            f"focal length to the right and {down:+.1f} % further down, as by a wedge of glass or "
            "a tilted lens"
        )
    return (
        f"Walls fit better if the principal point lay {first:+z.0f} % of the focal length to the "
        f"right and {down:+z.0f} % further down"
    )


def _counts(estimate: Estimate, least: float) -> bool:
    error = estimate.size_error
    return estimate.size > max(least, _SIGMAS * error) and error < _CAMERA_SE


def _curved(shape: ImageShape) -> Finding | None:
    """Judge whether the target itself is bent: the same on the wall from wherever it is seen."""
    curvature, error = np.abs(shape.curvature.value), shape.curvature.error
    sag = curvature * shape.half_width**2
    if not ((sag > _SAG) & (curvature > _SIGMAS * error)).any():
        return None
    return Finding(
        "target",
        "doubtful",
        f"The target is bent by {1e3 * float(sag.max()):.0f} mm within {shape.half_width:.1f} m of "
        "its middle, from wherever it is seen: use a flat one, or mask what is not.",
        spoils=True,
    )
