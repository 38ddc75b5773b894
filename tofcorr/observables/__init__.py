"""What a camera shows beside its bias: noise, missing pixels, amplitude; measured and compared."""

from tofcorr.observables.compare import Observables, compare_observables
from tofcorr.observables.dropout_model import DropoutModel
from tofcorr.observables.dropouts import DropoutMeasurement, measure_dropouts
from tofcorr.observables.noise import NoiseMeasurement, measure_noise
from tofcorr.observables.noise_curve import NoiseCurve

__all__ = [
    "DropoutMeasurement",
    "DropoutModel",
    "NoiseCurve",
    "NoiseMeasurement",
    "Observables",
    "compare_observables",
    "measure_dropouts",
    "measure_noise",
]
