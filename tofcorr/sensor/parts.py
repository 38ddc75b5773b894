"""The error terms and the noise of a sensor."""

import math
from dataclasses import replace

import torch
from torch import Tensor, nn
from torch.nn.functional import conv1d

from tofcorr.correction.model import signal_error
from tofcorr.error_terms.base import EVERYTHING, Domain, Interval
from tofcorr.error_terms.model import ErrorModel, ErrorModelOptions
from tofcorr.errors import ConfigError
from tofcorr.estimation.noise import NoiseModel
from tofcorr.sensor.sensor_file import ErrorSection

# How often the measured distance is put into its own error. Each time the deviation is multiplied
# by the slope of the error, 0.05 at most: after 3 times 6e-6 of the error is left. Derived.
_ITERATIONS = 3


class BaseError(nn.Module):
    r"""Error of the measured distance: constant and error terms.

    .. math:: D = D_\mathrm{true} + E(x, I, r, c, \text{conditions})

    where x is the true or the measured distance, as the sensor says. Distance and amplitude are
    held to the ranges that the sensor was measured in.

    Args:
        section: Terms and coefficients.
        domain: Image size and ranges.

    Attributes:
        model: The terms; their coefficients are the parameters.
    """

    mean_conditions: Tensor

    def __init__(self, section: ErrorSection, domain: Domain) -> None:
        super().__init__()
        self.reads_measured = section.reads == "measured_distance"
        self.model = error_model_of(section, domain)
        self.model_options = ErrorModelOptions(terms=section.terms)
        self.domain = domain
        self.limits = self.model.limits(domain)
        if not self.reads_measured:
            self.limits = replace(self.limits, radial_distance=self._true_range(domain))
        means = torch.tensor(domain.mean_conditions(), dtype=torch.float64)
        self.register_buffer("mean_conditions", means)

    @property
    def needs_amplitude(self) -> bool:
        """Whether a term reads the amplitude."""
        return self.model.needs_amplitude()

    @torch.no_grad()
    def _true_range(self, domain: Domain) -> Interval:
        """Return the true distances whose measured ones fill the range, in any pixel and light."""
        lights = (self.limits.amplitude if self.needs_amplitude else None) or Interval(1.0, 1.0)
        ends = []
        for distance in domain.radial_distance:
            like = self.model.constant.new_full((domain.height, domain.width), distance)
            ends.append([self.model(like, torch.full_like(like, light)) for light in lights])
        (near, far), (low, high) = (torch.stack(end) for end in ends), domain.radial_distance
        return Interval(low - float(near.max()), high - float(far.min()))

    def forward(self, true: Tensor, amplitude: Tensor, conditions: Tensor | None) -> Tensor:
        """Return measured minus true distance, shape (..., H, W), metres.

        Args:
            true: True distances along the ray, shape (..., H, W), metres, all finite.
            amplitude: The camera's units, the same shape; any values if no term reads them.
            conditions: Shape (..., C) or (C,); None: the mean conditions.
        """
        fixed = self.model.pixel_error()
        if conditions is not None and len(self.model.condition_terms):
            fixed = fixed + self.model.condition_error(conditions)[..., None, None]
        held = amplitude.clamp(*(self.limits.amplitude or EVERYTHING))
        bounds = self.limits.normalised_amplitude or EVERYTHING
        error = torch.zeros_like(true)
        for _ in range(1 + _ITERATIONS if self.reads_measured else 1):
            distance = (true + error).clamp(*self.limits.radial_distance)
            error = fixed + signal_error(self.model, distance, held, bounds)
        return error.expand(true.shape)


def error_model_of(section: ErrorSection, domain: Domain) -> ErrorModel:
    """Build the error model of a file's section.

    Raises:
        ConfigError: A coefficient is missing.
    """
    model = ErrorModel(ErrorModelOptions(terms=section.terms), domain)
    groups = {
        group: {symbol: math.nan if value is None else value for symbol, value in named.items()}
        for group, named in section.coefficients.items()
    }
    try:
        model.set_paper_coefficients(groups)
    except KeyError as error:
        raise ConfigError(
            f"sensor: error.coefficients lack {error}, which a term of error.terms has."
        ) from None
    return model


def section_of(model: ErrorModel, section: ErrorSection) -> ErrorSection:
    """Return a section with the coefficients that a model has now."""
    groups = {
        group: {symbol: None if math.isnan(v) else v for symbol, v in named.items()}
        for group, named in model.paper_coefficients().items()
    }
    return section.model_copy(update={"coefficients": groups})


class SensorNoise(nn.Module):
    r"""Noise along the ray, :math:`\sigma(A) \epsilon`, with the sigma of `NoiseModel`.

    :math:`\epsilon` has variance 1 and is correlated between neighbours; a share of its variance is
    the same in every frame. Differentiable in f, s, r, distance and amplitude.

    Args:
        section: The numbers.
        size: Height and width of the image.

    Attributes:
        deviations: f, s and r, shape (3,), metres; any sign.
    """

    fixed: Tensor
    kernel: Tensor

    def __init__(self, section: NoiseModel, size: tuple[int, int]) -> None:
        super().__init__()
        self.section = section
        self.deviations = nn.Parameter(torch.tensor(section.deviations, dtype=torch.float64))
        width = section.correlation_px
        # A Gaussian filter that keeps the variance of white noise; 0.006 % of it lies beyond 4.
        reach = max(1, math.ceil(4 * width)) if width > 0 else 0
        at = torch.arange(-reach, reach + 1, dtype=torch.float64)
        weights = torch.exp(-0.5 * (at / (width or 1.0)) ** 2)
        self.register_buffer("kernel", weights / weights.norm())
        camera = torch.Generator().manual_seed(section.fixed_seed)
        self.register_buffer("fixed", self._drawn(torch.zeros(size, dtype=torch.float64), camera))

    @property
    def needs_amplitude(self) -> bool:
        """Whether the noise depends on the amplitude."""
        return self.section.needs_amplitude

    def sigma(self, distance: Tensor, amplitude: Tensor) -> Tensor:
        """Return the standard deviation along the ray, as `NoiseModel.sigma` does."""
        return self.section.sigma(distance, amplitude, self.deviations.unbind())

    def draw(self, like: Tensor, generator: torch.Generator | None) -> Tensor:
        """Draw noise of standard deviation 1, shape (..., H, W), dtype and device of `like`."""
        share, noise = self.section.fixed_share, self._drawn(like, generator)
        if share == 0:
            return noise
        return math.sqrt(1 - share) * noise + math.sqrt(share) * self.fixed.to(like.dtype)

    def to_section(self) -> NoiseModel:
        """Return the numbers of now."""
        floor, shot, read = self.deviations.detach().abs().tolist()
        return self.section.model_copy(update={"floor_m": floor, "shot_m": shot, "read_m": read})

    def _drawn(self, like: Tensor, generator: torch.Generator | None) -> Tensor:
        """Draw noise that is the same in no two frames, as `draw` does."""
        reach = self.kernel.numel() // 2
        height, width = like.shape[-2:]
        size = (like[..., 0, 0].numel(), height + 2 * reach, width + 2 * reach)
        drawn = torch.randn(size, generator=generator, dtype=like.dtype, device=like.device)
        if reach:
            for _ in range(2):  # Along the rows, then along the columns.
                lines = drawn.flatten(0, 1)[:, None]
                filtered = conv1d(lines, self.kernel.to(like.dtype)[None, None])
                drawn = filtered.reshape(*drawn.shape[:2], -1).mT
        return drawn.reshape(like.shape)
