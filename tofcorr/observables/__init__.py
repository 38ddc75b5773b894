"""What a camera shows beside its bias: noise, missing pixels, amplitude; measured and compared."""

from tofcorr.estimation.noise import NoiseModel
from tofcorr.observables.compare import Observables, compare_observables
from tofcorr.observables.dropouts import DropoutMeasurement, DropoutModel, measure_dropouts
from tofcorr.observables.noise import NoiseMeasurement, measure_noise

__all__ = [
    "DropoutMeasurement",
    "DropoutModel",
    "NoiseMeasurement",
    "NoiseModel",
    "Observables",
    "compare_observables",
    "measure_dropouts",
    "measure_noise",
]
