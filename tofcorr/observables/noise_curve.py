r"""The standard deviation of a pixel's noise, as a function of amplitude or distance.

.. math:: \sigma^2 = f^2 + s^2 \frac{A_0}{A} + r^2 \left(\frac{A_0}{A}\right)^2

with floor f, shot noise s of the signal, and r of readout and background light; the same law as in
`tofcorr.estimation.noise`. Light falls with the square of the distance: without amplitude, A0/A is
(D/D0)^2, so that s belongs to a part of sigma linear in the distance, and r to a quadratic one.
"""

from dataclasses import asdict, dataclass, replace
from typing import Any, Self, TypeVar

import numpy as np
from torch import Tensor

ArrayT = TypeVar("ArrayT", np.ndarray, Tensor)

LEAST_VARIANCE = 1e-14
"""Square metres, (0.1 um)^2: less counts as free of noise. Chosen: float32 depth of 1 m is rounded
to 0.06 um."""


@dataclass(frozen=True, kw_only=True)
class NoiseCurve:
    """Noise of one pixel: its whole variance, and which share of it never changes.

    Attributes:
        floor_m: Standard deviation that brightness does not change, metres.
        shot_m: Standard deviation by shot noise at the reference, metres.
        read_m: Standard deviation by readout and background light at the reference, metres.
        reference_amplitude: A0, the median amplitude measured, counts; None: no amplitude.
        reference_distance_m: D0, the median distance measured, metres.
        least_brightness: Smallest A/A0 (or (D0/D)^2) measured. Darker pixels get its noise.
        fixed_share: Share of the variance that is the same in all frames, pixel by pixel, 0 to 1;
            the rest is drawn anew in each frame.
        correlation_px: Standard deviation, in pixels, of the Gaussian filter that makes white
            noise as correlated as this noise (`tofcorr.observables.filter_width`); 0: white.
    """

    floor_m: float
    shot_m: float
    read_m: float
    reference_amplitude: float | None
    reference_distance_m: float
    least_brightness: float
    fixed_share: float
    correlation_px: float

    def sigma(self, distance: ArrayT, amplitude: ArrayT | None = None) -> ArrayT:
        """Return the standard deviation of the whole noise, fixed and temporal.

        Args:
            distance: Radial distances, any shape, metres; read only without a reference amplitude.
            amplitude: Amplitudes of that shape, counts; needed with a reference amplitude.

        Returns:
            Shape of `distance`, metres.

        Raises:
            ValueError: The curve depends on amplitude, and none is given.
        """
        if self.reference_amplitude is None:
            brightness = (self.reference_distance_m / distance) ** 2
        elif amplitude is None:
            raise ValueError("This noise curve depends on the amplitude; none is given.")
        else:
            brightness = amplitude / self.reference_amplitude
        darkness = 1.0 / brightness.clip(min=self.least_brightness)
        variance = self.floor_m**2 + self.shot_m**2 * darkness + self.read_m**2 * darkness**2
        return variance**0.5

    def temporal_sigma(self, distance: ArrayT, amplitude: ArrayT | None = None) -> ArrayT:
        """Return the standard deviation of what changes from frame to frame, as `sigma` does."""
        return self.sigma(distance, amplitude) * (1.0 - self.fixed_share) ** 0.5

    def with_fixed_share(self, share: float) -> Self:
        """Return the curve of a whole noise of which this temporal one leaves a fixed share.

        Args:
            share: Share of the whole variance that never changes, 0 to below 1.
        """
        more = (1.0 - share) ** -0.5
        return replace(
            self,
            floor_m=self.floor_m * more,
            shot_m=self.shot_m * more,
            read_m=self.read_m * more,
            fixed_share=share,
        )

    def to_dict(self) -> dict[str, Any]:
        """Return plain values, for YAML and JSON; lengths in metres."""
        return asdict(self)
