"""The sections of `sensor.yaml` that describe one pixel: noise, missing pixels, light."""

from typing import Annotated

from pydantic import Field

from tofcorr.data.header import Number, PositiveNumber
from tofcorr.options import Options

NonNegative = Annotated[Number, Field(ge=0)]
Share = Annotated[Number, Field(ge=0, le=1)]


class NoiseSection(Options):
    r"""The standard deviation of one distance along the ray.

    .. math:: \sigma^2 = f^2 + s^2 \frac{A_0}{A} + r^2 \left(\frac{A_0}{A}\right)^2

    Without amplitudes, A0 / A is (D / D0)^2.

    Attributes:
        floor_m: f, what brightness does not change.
        shot_m: s, shot noise at the reference.
        read_m: r, readout and background light at the reference.
        reference_amplitude: A0; null: no amplitude was recorded.
        reference_distance_m: D0.
        least_brightness: Smallest A / A0 measured; darker pixels get its noise.
        fixed_share: Share of the variance that is the same in every frame, pixel by pixel.
        correlation_px: Standard deviation, in pixels, of the Gaussian filter that makes white noise
            as correlated as this noise; 0: white.
        fixed_seed: Of the fixed part. The pixels of one camera are not known from its statistics:
            it is that of a camera of this kind.
    """

    floor_m: NonNegative
    shot_m: NonNegative = 0.0
    read_m: NonNegative = 0.0
    reference_amplitude: PositiveNumber | None = None
    reference_distance_m: PositiveNumber = 1.0
    least_brightness: Annotated[Number, Field(gt=0)] = 0.01
    fixed_share: Share = 0.0
    correlation_px: Annotated[Number, Field(ge=0, le=50)] = 0.0
    fixed_seed: Annotated[int, Field(ge=0)] = 1


class DropoutSection(Options):
    r"""The probability that a pixel gives no distance.

    .. math:: P = b + (1 - b) / (1 + (A / A_{1/2})^{1/w})

    Attributes:
        base_share: b, missing at any amplitude.
        amplitude_at_half: A_1/2; null: the amplitude plays no part.
        width: w, of the transition in ln A.
        saturation_amplitude: The largest amplitude that the camera states; a pixel that reaches it
            is not valid. Null: unknown.
        saturated_share: Share of those pixels that have no distance; null: as darker ones.
    """

    base_share: Share = 0.0
    amplitude_at_half: PositiveNumber | None = None
    width: PositiveNumber = 0.1
    saturation_amplitude: PositiveNumber | None = None
    saturated_share: Share | None = None


class LightSection(Options):
    """The amplitude that a surface returns, for scenes that state a reflectivity.

    Attributes:
        amplitude_at_1m: Of a frontal surface of reflectivity 1 at 1 m, on the optical axis.
        vignetting_exponent: n of cos^n of the angle to the optical axis.
        usual_reflectivity: Taken where a scene states neither amplitude nor reflectivity.
    """

    amplitude_at_1m: PositiveNumber
    vignetting_exponent: NonNegative = 0.0
    usual_reflectivity: Annotated[Number, Field(gt=0, le=1)] = 0.5
