"""Has the image the focal length, and the depth the kind, that the header says?"""

import numpy as np

from tofcorr.plausibility.finding import Finding
from tofcorr.plausibility.image_shape import ImageShape
from tofcorr.plausibility.look import Look

# An estimate counts from so many of its standard errors on. Chosen: no clean recording of 200
# reached five (benchmarks/faults_in_recordings.py).
_SIGMAS = 6.0
# Error of the focal length that counts, and that makes a fit meaningless, without unit. Chosen: 3 %
# bends a wall tilted by 30 degrees by a centimetre at the border of the image.
_FOCAL, _OTHER_CAMERA = 0.03, 0.25
# Shift of the principal point that counts, in focal lengths. Chosen: 2 degrees.
_CENTRE = 0.04
# Largest standard error of each estimate at which it is looked at. Chosen.
_FOCAL_SE, _KIND_SE = 0.03, 0.1
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
    return _kind(look, shape) or _focal(shape) or _centre(shape) or _curved(look, shape)


def _kind(look: Look, shape: ImageShape) -> list[Finding]:
    declared = look.sample.recording.depth_kind
    other = "z" if declared == "radial" else "radial"
    if shape.kind_se < _KIND_SE and _OTHER < shape.kind < 1 + _OTHER:
        return [
            Finding(
                "kind",
                "impossible",
                f"recording.yaml says depth_kind: {declared}, but walls are bent as if the depth "
                f"were {other} ({100 * shape.kind:.0f} % of the difference, standard error "
                f"{100 * shape.kind_se:.0f} %); write depth_kind: {other}.",
            )
        ]
    return []


def _focal(shape: ImageShape) -> list[Finding]:
    strong = abs(shape.focal) > _SIGMAS * shape.focal_se and abs(shape.focal) > _FOCAL
    if strong and shape.focal_se < _FOCAL_SE:
        word = "longer" if shape.focal > 0 else "shorter"
        return [
            Finding(
                "focal length",
                "impossible" if abs(shape.focal) > _OTHER_CAMERA else "doubtful",
                f"Walls fit better if the focal length were {100 * abs(shape.focal):.0f} % {word} "
                f"(standard error {100 * shape.focal_se:.1f} %): is K of this camera, and of this "
                "resolution?",
                spoils=True,
            )
        ]
    return []


def _curved(look: Look, shape: ImageShape) -> list[Finding]:
    """Judge whether the target itself is bent: the same on the wall from wherever it is seen."""
    curvature, error = np.abs(shape.curvature), shape.curvature_se
    sag = curvature * shape.half_width**2
    bent = (sag > _SAG) & (curvature > _SIGMAS * error)
    if not bent.any():
        return []
    return [
        Finding(
            "target",
            "doubtful",
            f"The target is bent by {1e3 * float(sag.max()):.0f} mm within "
            f"{shape.half_width:.1f} m of its middle, from wherever it is seen: use a flat one, or "
            "mask what is not.",
            spoils=True,
        )
    ]


def _centre(shape: ImageShape) -> list[Finding]:
    size, error = np.hypot(*shape.centre), np.hypot(*shape.centre_se)
    if size < max(_CENTRE, _SIGMAS * error) or error > _FOCAL_SE:
        return []
    right, down = 100 * shape.centre
    return [
        Finding(
            "principal point",
            "doubtful",
            f"Walls fit better if the principal point lay {right:+.0f} % of the focal length to "
            f"the right and {down:+.0f} % further down (standard error {100 * error:.1f} %): is K "
            "of this crop of the image?",
            spoils=True,
        )
    ]
