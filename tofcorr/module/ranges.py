"""The calibrated ranges of a correction, as buffers."""

import torch
from torch import Tensor, nn

from tofcorr.conditions import CONDITIONS
from tofcorr.correction.limits import Limits
from tofcorr.error_terms.domain import Domain
from tofcorr.error_terms.model import ErrorModel


class CalibratedRanges(nn.Module):
    """Where a correction is valid, and the mean conditions it was calibrated in.

    Attributes:
        radial_distance: Lowest and highest distance along the ray, shape (2,), metres.
        amplitude: Of the amplitude, shape (2,); infinite if the model does not depend on it.
        normalised_amplitude: Of N = I D^2, shape (2,); infinite likewise.
        saturation_amplitude: A pixel at or above it is not valid, shape (); infinite if unknown.
        mean_conditions: In the order of `CONDITIONS`, shape (C,); 0 where unknown.
    """

    radial_distance: Tensor
    amplitude: Tensor
    normalised_amplitude: Tensor
    saturation_amplitude: Tensor
    mean_conditions: Tensor

    def __init__(self) -> None:
        super().__init__()
        for name in ("radial_distance", "amplitude", "normalised_amplitude"):
            self.register_buffer(name, torch.zeros(2, dtype=torch.float64))
        self.register_buffer("saturation_amplitude", torch.zeros((), dtype=torch.float64))
        means = torch.zeros(len(CONDITIONS), dtype=torch.float64)
        self.register_buffer("mean_conditions", means)

    @torch.no_grad()
    def set(self, domain: Domain, saturation: float | None, error: ErrorModel) -> None:
        """Take the ranges of a calibration.

        Args:
            domain: The calibrated ranges.
            saturation: Amplitude from which on pixels are saturated; None if unknown.
            error: The model, whose terms say which variables it depends on.
        """
        limits = Limits.of_domain(domain, saturation, error)
        for name in ("radial_distance", "amplitude", "normalised_amplitude"):
            getattr(self, name).copy_(torch.tensor(getattr(limits, name), dtype=torch.float64))
        self.saturation_amplitude.fill_(limits.saturation_amplitude)
        means = torch.tensor(domain.mean_conditions(), dtype=torch.float64)
        self.mean_conditions.copy_(means)
