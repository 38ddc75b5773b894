"""The amplitude that a scene returns, from its reflectivity."""

from torch import Tensor

from tofcorr.sensor.pixel_sections import LightSection


def amplitude_of(
    section: LightSection,
    reflectivity: Tensor,
    radial_distance: Tensor,
    incidence_cosine: Tensor,
    ray_directions: Tensor,
) -> Tensor:
    r"""Return the amplitude of Lambertian surfaces lit from beside the camera.

    .. math:: A = A_1 \rho \cos\theta \cos^n\alpha / d^2

    with the angle of incidence theta and the angle alpha of the ray to the optical axis.

    Args:
        section: A_1 and n.
        reflectivity: rho, shape (..., H, W), 0 to 1.
        radial_distance: d, shape (..., H, W), metres.
        incidence_cosine: Shape (..., H, W).
        ray_directions: Unit rays, shape (H, W, 3).

    Returns:
        Shape (..., H, W), the camera's units.
    """
    lit = section.amplitude_at_1m * incidence_cosine * reflectivity / radial_distance.square()
    if section.vignetting_exponent == 0:
        return lit
    return lit * ray_directions[..., 2] ** section.vignetting_exponent
