"""The light that returns: inverse square law, incidence, vignetting, integration time."""

from typing import Annotated

from pydantic import Field
from torch import Tensor

from tofcorr.options import Options
from tofcorr.simulation.numbers import NonNegativeNumber, PositiveNumber


class LightOptions(Options):
    """Light source, lens and sensitivity of the pixel.

    Attributes:
        electrons_at_1m: Mean number of electrons in one tap at 1 m from a frontal wall of
            reflectivity 1, on the optical axis, in the reference integration time.
        reference_integration_time_us: Integration time of `electrons_at_1m`.
        demodulation_contrast: Amplitude over the mean of the taps, without ambient light.
        vignetting_exponent: n of cos^n of the angle to the optical axis; a simple lens has 4.
    """

    electrons_at_1m: PositiveNumber = 300_000.0
    reference_integration_time_us: PositiveNumber = 500.0
    demodulation_contrast: Annotated[float, Field(gt=0, le=1)] = 0.5
    vignetting_exponent: NonNegativeNumber = 4.0

    def exposure(self, integration_time: float | None) -> float:
        """Return the integration time over the reference; 1 if it is unknown."""
        if integration_time is None:
            return 1.0
        return integration_time / (self.reference_integration_time_us * 1e-6)


def amplitude_per_reflectivity(
    options: LightOptions,
    radial_distance: Tensor,
    incidence_cosine: Tensor,
    ray_directions: Tensor,
    integration_time: float | None,
) -> Tensor:
    """Return the amplitude in electrons for a wall of reflectivity 1.

    A source beside the camera lights a Lambertian wall in proportion to cos(incidence) /
    distance^2. The way back adds no factor: a pixel sees a larger patch in proportion to
    distance^2, which cancels the fall-off of the light from each point.

    Args:
        options: Source, lens and sensitivity.
        radial_distance: Shape (H, W), metres.
        incidence_cosine: Shape (H, W).
        ray_directions: Unit viewing rays in the camera frame, shape (H, W, 3).
        integration_time: Seconds; None if unknown.

    Returns:
        Shape (H, W), electrons.
    """
    vignetting = ray_directions[..., 2] ** options.vignetting_exponent
    electrons = options.electrons_at_1m * options.exposure(integration_time)
    modulated = electrons * options.demodulation_contrast
    return modulated * vignetting * incidence_cosine / radial_distance**2
