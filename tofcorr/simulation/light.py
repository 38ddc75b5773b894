"""How much light returns: inverse square, incidence, vignetting, integration time."""

from typing import Annotated

from pydantic import Field
from torch import Tensor

from tofcorr.options import Options
from tofcorr.simulation.numbers import NonNegativeNumber, PositiveNumber


class LightOptions(Options):
    """Light source, lens and the pixel's yield.

    Attributes:
        electrons_at_1m: Electrons that the light leaves in one tap on the average, at 1 m from a
            frontal wall of reflectivity 1, on the optical axis, in the reference time.
        reference_integration_time_us: The integration time that goes with it.
        demodulation_contrast: Amplitude over mean of the taps without ambient light.
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
    """Return the amplitude in electrons that a wall of reflectivity 1 gives.

    A source beside the camera lights a Lambertian wall with cos(incidence) / distance^2. How
    bright the lit wall looks does not depend on the distance again: the patch that a pixel sees
    grows as the light from each of its points fades.

    Args:
        options: Source, lens and yield.
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
