"""Compares what a recording and a simulated one show beside their bias."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from tofcorr.data.recording import Recording
from tofcorr.observables.compare_amplitude import AmplitudeComparison, compare_amplitude
from tofcorr.observables.compare_dropouts import DropoutComparison, compare_dropouts
from tofcorr.observables.compare_noise import NoiseComparison, compare_noise
from tofcorr.observables.dropouts import DropoutMeasurement, dropouts_of
from tofcorr.observables.matched import Matched, matched
from tofcorr.observables.noise import NoiseMeasurement, noise_of, noise_source
from tofcorr.observables.observed import Observed, observe


@dataclass(frozen=True, kw_only=True, eq=False)
class Observables:
    """Noise, missing pixels and amplitude of a recording, and of a simulated one if there is one.

    Attributes:
        seen: What was read of the recording.
        real_noise: Noise of the recording, by its best source.
        real_dropouts: Missing and saturated pixels of the recording.
        noise: The comparison; None without a simulated recording.
        dropouts: The comparison; None without a simulated recording.
        amplitude: The comparison; None if one of the recordings has no amplitude.
        both: The pixels compared; None without a simulated recording.
    """

    seen: Observed
    real_noise: NoiseMeasurement
    real_dropouts: DropoutMeasurement
    noise: NoiseComparison | None
    dropouts: DropoutComparison | None
    amplitude: AmplitudeComparison | None
    both: Matched | None

    def to_dict(self) -> dict[str, Any]:
        """Return the blocks `noise`, `dropouts` and `amplitude` of diagnosis.json."""
        blocks = {"noise": self.noise, "dropouts": self.dropouts, "amplitude": self.amplitude}
        return {key: None if block is None else block.to_dict() for key, block in blocks.items()}

    @property
    def explained_by(self) -> tuple[str, ...]:
        """What of the camera the simulator lacks or exaggerates; empty: nothing was found."""
        blocks = (self.noise, self.dropouts, self.amplitude)
        return tuple(cause for block in blocks if block is not None for cause in block.explained_by)


def compare_observables(
    real: Recording, sim: Recording | None, *, seed: int, level: float = 0.05
) -> Observables:
    """Compare noise, missing pixels and amplitude, with poses as the unit of every test.

    At the same poses the same pixels are compared. At other poses, pixels of like brightness and
    target are: brightness is the amplitude in a unit that both share, or cos / d^2.

    Args:
        real: The recording.
        sim: The simulated one, with the noise that the simulator states; None: the recording alone
            is measured.
        seed: Of resamples and permutations.
        level: Significance level of what is reported.

    Raises:
        CalibrationDataError: One of them has no image with 100 usable pixels, or breaks the format.
    """
    seen = observe(real)
    noise, dropouts = noise_of(seen), dropouts_of(seen)
    if sim is None:
        return Observables(
            seen=seen,
            real_noise=noise,
            real_dropouts=dropouts,
            noise=None,
            dropouts=None,
            amplitude=None,
            both=None,
        )
    simulated = observe(sim)
    lost = dropouts_of(simulated)
    amplitudes = (dropouts.amplitude, lost.amplitude)
    both = matched(seen, simulated, amplitudes)
    alike = both if both.paired else matched(seen, simulated, None)
    # Both noises come from one source, so that its errors cancel.
    sources = {noise_source(seen), noise_source(simulated)}
    source = "neighbours" if len(sources) > 1 else noise.source
    comparable = noise if source == noise.source else noise_of(seen, source)
    random = np.random.default_rng(seed)
    shape = (real.camera.height, real.camera.width)
    return Observables(
        seen=seen,
        real_noise=noise,
        real_dropouts=dropouts,
        noise=compare_noise(both, comparable, noise_of(simulated, source), random, level),
        dropouts=compare_dropouts(both, dropouts, lost, random, level),
        amplitude=compare_amplitude(alike, amplitudes, shape, random, level),
        both=both,
    )
