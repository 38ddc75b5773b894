"""From expected electrons to counts: shot noise, read noise, full well and converter."""

from typing import Annotated

import torch
from pydantic import Field
from torch import Tensor

from tofcorr.options import Options
from tofcorr.simulation.numbers import NonNegativeNumber, PositiveNumber


class ReadoutOptions(Options):
    """Noise and converter.

    Attributes:
        read_noise_electrons: Standard deviation in each sample.
        electrons_per_count: Electrons per count of the converter. Amplitude, ambient light and raw
            samples of the recording are in counts.
        converter_bits: Resolution. A pixel with a sample at the largest count has no distance.
        full_well_electrons: Largest charge of a tap; null: more than the converter can show.
        least_amplitude_counts: Pixels with a smaller amplitude have no distance.
    """

    read_noise_electrons: NonNegativeNumber = 200.0
    electrons_per_count: PositiveNumber = 40.0
    converter_bits: Annotated[int, Field(ge=4, le=32)] = 16
    full_well_electrons: PositiveNumber | None = None
    least_amplitude_counts: NonNegativeNumber = 0.0

    def largest_count(self) -> float:
        """Return the count at which a sample is saturated."""
        largest = 2.0**self.converter_bits - 1
        if self.full_well_electrons is None:
            return largest
        return min(largest, self.full_well_electrons / self.electrons_per_count)


def read_out(taps: Tensor, options: ReadoutOptions, generator: torch.Generator | None) -> Tensor:
    """Return the samples in counts.

    Photo-electrons are Poisson distributed, read noise is normal, the converter rounds and clips.

    Args:
        taps: Expected electrons, shape (4, H, W).
        options: Noise and converter.
        generator: Source of randomness; None: expected counts, neither rounded nor limited.

    Returns:
        Counts, shape (4, H, W).
    """
    if generator is None:
        return taps / options.electrons_per_count
    electrons = torch.poisson(taps.nan_to_num(0.0).clamp_min(0.0), generator)
    read_noise = torch.randn(taps.shape, generator=generator, dtype=taps.dtype)
    electrons = electrons + options.read_noise_electrons * read_noise
    counts = torch.round(electrons / options.electrons_per_count)
    return counts.clamp(0.0, options.largest_count())


def has_distance(
    counts: Tensor, amplitude: Tensor, options: ReadoutOptions, *, noisy: bool
) -> Tensor:
    """Return True where a pixel has a distance: no sample saturated, amplitude large enough.

    Args:
        counts: Samples, shape (4, H, W).
        amplitude: Counts, shape (H, W).
        options: Converter and threshold.
        noisy: Whether the converter's limits were applied.
    """
    bright_enough = (amplitude >= options.least_amplitude_counts) & (amplitude > 0)
    if not noisy:
        return bright_enough
    return bright_enough & (counts < options.largest_count()).all(0)
