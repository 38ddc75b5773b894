"""A simulator that saw other poses: its error along every covariate, carried to the recording."""

from tofcorr.diagnosis.given.simulator import Simulated
from tofcorr.diagnosis.options import DiagnosisOptions
from tofcorr.diagnosis.sums.observations import Observations
from tofcorr.diagnosis.sums.pixel_noise import PixelNoise


def simulated_elsewhere(
    frames: Observations, noise: PixelNoise, real: Observations, options: DiagnosisOptions
) -> Simulated:
    """Fit the simulator's error to its own frames, and predict it for a recording's pixels."""
    raise NotImplementedError
