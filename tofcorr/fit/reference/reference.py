"""What is known of a calibrated camera beyond its corrector: form, poses and noise."""

from dataclasses import dataclass

import torch
from torch import Tensor

from tofcorr.correction.state import CalibrationState
from tofcorr.estimation.noise import DistanceNoise
from tofcorr.fit.reference.form_functions import SHAPES, FormFunctions
from tofcorr.fit.reference.linear_image import LinearImage

# Noise of a pixel where nothing is known, metres: only a scale, since the noise of each image is
# measured; and the least noise, so that no pixel counts for all. Chosen.
_TYPICAL_NOISE, _LEAST_NOISE = 5e-3, 1e-4
# How much a robot's poses vary where nothing is known, metres and radians: only a scale as well.
_TYPICAL_POSE = 1e-3


@dataclass(frozen=True)
class Reference:
    """How far the camera may be from what its calibration says.

    Attributes:
        mean: What is left in the residuals along the twist of the hand-eye (if it was estimated),
            the coefficients and the functions of `FormFunctions`, shape (P,); metres, radians. The
            unknowns are those of `LinearImage.unknowns`.
        covariance: Of these, shape (P, P).
        random_variance: Of what differs from image to image, shape (3 + S,), square radians and
            metres: two turns and a shift of the wall, by the robot and all else, and the smooth
            errors of `form_functions.shapes`.
        bow_variance: Of a bow of the wall that all images share, square metres.
        persistence: Correlation of the shifts of one pose and the next; 0: poses are independent.
        poses: From how many poses of the robot this is known.
        noise: a, b, c of the variance of a measured distance; None: the same for all pixels.
        scatter: Mean square of the images' departures from each other, whatever their walls, over
            what noise and smooth errors let expect; see `scatter`.
        covariance_within: The covariance where only the insides of images are looked at. What all
            images have alike, such as a fixed pattern, is then in both recordings, and what is left
            is as small as they depart from each other. None: as `covariance`.
        views: From where each pose saw its wall, shape (K, 7); see `view_of`. None: not known.
    """

    mean: Tensor
    covariance: Tensor
    random_variance: Tensor
    bow_variance: float
    persistence: float
    poses: int
    noise: tuple[float, float, float] | None
    scatter: float = 1.0
    covariance_within: Tensor | None = None
    views: Tensor | None = None

    @property
    def independent_poses(self) -> float:
        """How many independent poses would tell as much as these."""
        return self.poses / repeated(self.persistence, self.poses)


def repeated(persistence: float, count: int) -> float:
    """Return by how much the variance of a mean exceeds that of independent values.

    Args:
        persistence: Correlation r of one value and the next; r^k that of values k apart.
        count: How many values.

    Example:
        >>> round(repeated(0.5, 2), 2)
        1.5
    """
    return 1 + 2 * sum((1 - k / count) * persistence**k for k in range(1, count))


def num_unknowns(state: CalibrationState) -> int:
    """Return how many unknowns a reference of a calibration has: twist, coefficients, form."""
    functions = len(FormFunctions(state.domain).classes())
    return (6 if state.hand_eye_estimated else 0) + len(state.coefficients) + functions


def unknown_reference(state: CalibrationState, *, wall_is_known: bool) -> Reference:
    """Return what a run without a reference knows: the covariance of its coefficients.

    Before a known wall that is left out: the hand-eye transform, whose covariance with the
    coefficients is unknown, makes up for most of their errors there.
    """
    twist, size = 6 if state.hand_eye_estimated else 0, num_unknowns(state)
    covariance = torch.zeros(size, size, dtype=torch.float64)
    if state.covariance is not None and not wall_is_known:
        own = slice(twist, twist + len(state.coefficients))
        covariance[own, own] = state.covariance
    return Reference(
        mean=torch.zeros(size, dtype=torch.float64),
        covariance=covariance,
        random_variance=torch.tensor([_TYPICAL_POSE**2] * 3 + [_LEAST_NOISE**2] * SHAPES).double(),
        bow_variance=_LEAST_NOISE**2,
        persistence=0.0,
        poses=0,
        noise=state.noise,
    )


def pixel_weights(noise: tuple[float, float, float] | None, image: LinearImage) -> Tensor:
    """Return one over the variance of each pixel's noise, shape (M,), 1 / m^2."""
    if noise is None or image.amplitude is None:
        return torch.full_like(image.residual, _TYPICAL_NOISE**-2)
    variance = DistanceNoise(*noise, source="neighbours").variance(image.amplitude)
    return 1 / variance.clamp(min=_LEAST_NOISE**2)
