"""The range of the amplitude, and its logarithm."""

import torch
from torch import Tensor

from tofcorr.error_terms.domain import Domain, Interval
from tofcorr.errors import CalibrationDataError

# Amplitudes below this share of the calibrated maximum (no unit) enter the logarithm as this
# share: the logarithm of a dead pixel carries no information. Set by hand; four decades are more
# than any camera resolves.
LOG_FLOOR = 1e-4


def known_amplitude(domain: Domain) -> Interval:
    """Return the range of amplitudes.

    Raises:
        CalibrationDataError: The domain knows no amplitudes.
    """
    if domain.amplitude is None or domain.normalised_amplitude is None:
        raise CalibrationDataError(
            "The intensity term needs amplitude.npy, which the recording does not have: "
            "record amplitudes, or choose a model without an amplitude term."
        )
    return domain.amplitude


def amplitude_floor(domain: Domain) -> float:
    """Return the amplitude below which the logarithm is constant."""
    return max(known_amplitude(domain).high * LOG_FLOOR, 1e-30)


def log_interval(domain: Domain) -> Interval:
    """Return the range of the logarithm of the amplitude."""
    ends = torch.tensor(known_amplitude(domain), dtype=torch.float64)
    return Interval(*ends.clamp(min=amplitude_floor(domain)).log().tolist())


def log_amplitude(amplitude: Tensor, floor: Tensor) -> Tensor:
    """Return the logarithm of amplitudes (...), of `floor` () where they are below it."""
    return torch.maximum(amplitude, floor).log()
