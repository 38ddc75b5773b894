"""How far images depart from each other is measured between them, not within."""

import pytest
import torch

from tofcorr.estimation.linear import Estimate, GroupSums, Variances
from tofcorr.fit.reference import scatter, share_unlike

IMAGES, PIXELS = 200, 300


def sums(fixed: float, own: float) -> GroupSums:
    """Images of noise 1, of which a fixed pattern is the same in each, and of offsets of their own.

    Args:
        fixed: Share of the noise's variance that is the same in each image.
        own: Standard deviation of the offsets of the images.
    """
    generator = torch.Generator().manual_seed(3)
    place = torch.linspace(-1, 1, PIXELS, dtype=torch.float64)
    gain = -1 + 0.3 * place.square()
    moves = torch.stack([place, place**3, torch.ones_like(place)], dim=1)
    pattern = torch.randn(PIXELS, generator=generator, dtype=torch.float64)
    pattern *= fixed**0.5 / pattern.square().mean().sqrt()
    products = []
    for _ in range(IMAGES):
        noise = torch.randn(PIXELS + 1, generator=generator, dtype=torch.float64)
        residual = pattern + (1 - fixed) ** 0.5 * noise[1:] + own * noise[0] * gain
        # The pattern's own offset belongs to the calibration, which knows it.
        q = torch.linalg.qr(torch.cat([gain[:, None], moves], dim=1)).Q
        residual = residual - q @ (q.T @ pattern)
        columns = torch.cat([gain[:, None], moves, residual[:, None]], dim=1)
        products.append(columns.T @ columns)
    return GroupSums(torch.stack(products), torch.full((IMAGES,), float(PIXELS)).double(), 3)


def nothing_known() -> Estimate:
    none = torch.zeros(0, dtype=torch.float64)
    effects = torch.ones(3, dtype=torch.float64)
    return Estimate(none, torch.zeros(0, 0).double(), Variances(1.0, effects, none))


# The mean of 200 squares is known to a tenth; three of these.
@pytest.mark.parametrize("fixed", [0.0, 0.5])
def test_what_all_images_have_alike_makes_none_depart_from_another(fixed: float) -> None:
    assert scatter(sums(fixed, 0.0), nothing_known()) == pytest.approx(1 - fixed, rel=0.3)


def test_offsets_of_the_images_show_in_it() -> None:
    assert scatter(sums(0.0, 1.0), nothing_known()) > 3.0


def test_a_view_is_unlike_if_none_that_was_calibrated_is_near() -> None:
    generator = torch.Generator().manual_seed(1)
    calibrated = torch.rand(100, 7, generator=generator).double()
    like, far = torch.rand(100, 7, generator=generator).double(), calibrated + 3.0
    assert share_unlike(like, calibrated) < 0.2
    assert share_unlike(far, calibrated) == 1.0
    assert share_unlike(far, calibrated[:5]) == 0.0
