"""Probes: patterns that an error may have which the fitted model lacks.

A probe stands for more than one cause. The angle of incidence, say, is in the error of a glossy
wall, in that of light which went by other surfaces, and in that of a wrong focal length. So a probe
says that something is missing, and how far that may move the hand-eye transform; `tofcorr diagnose`
looks for the cause.
"""

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from tofcorr.fit.misfit.pixels import MisfitPixels
from tofcorr.geometry.ranges import phase_from_radial_distance

# Waves of the circular error in one unambiguous range: of the third harmonic with four taps (Lange
# 2000).
_WAVES = 4
# Amplitude ratios are cut here, no unit, so that single dark pixels do not decide. Chosen.
_MOST_BRIGHTER = 20.0
# Amplitudes are cut below at this share of their median: the logarithm of none is infinite. Chosen.
_DARKEST = 1e-3

Columns = Callable[[MisfitPixels], Tensor]
"""Computes what the residuals would be, shape (M, K); no unit is asked for."""


class Probe(NamedTuple):
    """One pattern.

    Attributes:
        name: For programs.
        trace: What the residuals do: it follows "the residuals".
        columns: Its columns.
    """

    name: str
    trace: str
    columns: Columns


def finer_forms(seen: MisfitPixels) -> list[Probe]:
    """Return errors over distance, pixel and amplitude that are finer than those of a usual model.

    What a smooth term cannot follow leaves some of itself in every other probe.
    """
    found = [
        Probe("distance", "follow the distance more finely than the model", _distance),
        Probe("pixel", "follow the place in the image more finely than the model", _pixel),
    ]
    if bool(seen.amplitude.isfinite().all()):
        trace = "follow the amplitude otherwise than the model"
        found.append(Probe("amplitude", trace, _amplitude))
    return found


def probes(seen: MisfitPixels) -> list[Probe]:
    """Return the other probes that a recording allows."""
    found = [
        Probe("incidence", "follow the angle of incidence", _incidence),
        Probe("order", "follow the order of the frames", _order),
        Probe("previous_frame", "follow the frame before", _previous_frame),
        Probe("focal_length", "are those of another focal length", _lens(_focal)),
        Probe("aspect", "are those of image axes that are scaled or tilted", _lens(_aspect, _skew)),
        Probe("principal_point", "are those of another principal point", _lens(_right, _down)),
        Probe("radial", "are those of another radial distortion", _lens(_radial)),
        Probe("prism", "are those of a wedge before the lens", _lens(_prism_x, _prism_y)),
        Probe("pixel_by_distance", "follow pixel and distance together", _pixel_by_distance),
        Probe("target_shape", "are those of a bent target", _target_shape),
        Probe("room", "grow as light from all sides makes them", _room),
        Probe("facing", "are those of light between target and camera", _facing),
    ]
    if not seen.walls_estimated:
        found.append(Probe("plane", "are those of planes elsewhere", _plane))
    if seen.modulation_frequency is not None:
        found.append(Probe("circular", "repeat over the distance", _circular))
    if bool(seen.amplitude.isfinite().all()):
        trace = "follow amplitude and distance together"
        found.append(Probe("amplitude_by_distance", trace, _amplitude_by_distance))
        found.append(Probe("stray_light", "are those of light that strayed in the lens", _stray))
    return found


def _error(seen: MisfitPixels, *values: Tensor) -> Tensor:
    """Return what errors of the distance (M,) do to the residual, shape (M, K)."""
    return seen.cosine[:, None] * torch.stack(values, dim=1)


def _standard(values: Tensor) -> Tensor:
    return (values - values.mean()) / values.std().clamp(min=1e-12)


def _distance(seen: MisfitPixels) -> Tensor:
    u = _standard(seen.distance)
    return _error(seen, u**4, u**5)


def _on_image(seen: MisfitPixels) -> tuple[Tensor, Tensor, Tensor]:
    x, y = (seen.ray[:, axis] / seen.ray[:, 2] for axis in (0, 1))
    return x, y, x * x + y * y


def _pixel(seen: MisfitPixels) -> Tensor:
    x, y, square = _on_image(seen)
    return _error(seen, x * y, square**2, x**3, y**3, x * x * y, x * y * y)


def _brightness(seen: MisfitPixels) -> Tensor:
    return _standard(seen.amplitude.clamp(min=_DARKEST * float(seen.amplitude.median())).log())


def _amplitude(seen: MisfitPixels) -> Tensor:
    return _error(seen, _brightness(seen), _brightness(seen) ** 2)


def _incidence(seen: MisfitPixels) -> Tensor:
    facing = -seen.cosine
    return _error(seen, 1 / facing - 1, (1 - facing) ** 2)


def _order(seen: MisfitPixels) -> Tensor:
    when = _standard(seen.frame.to(torch.float64))
    return _error(seen, when, when**2)


def _previous_frame(seen: MisfitPixels) -> Tensor:
    """Return the change since the frame before, and the error that a share of its light makes."""
    further = torch.where(seen.before.isfinite(), seen.before - seen.distance, 0.0)
    ratio = (seen.amplitude_before / seen.amplitude).clamp(max=_MOST_BRIGHTER).nan_to_num()
    return _error(seen, further, ratio * _of_phase(seen, further))


def _of_phase(seen: MisfitPixels, further: Tensor) -> Tensor:
    """Return the error (M,) by a weak signal of a longer path, in units of its share."""
    if seen.modulation_frequency is None:
        return further
    return torch.sin(phase_from_radial_distance(further, seen.modulation_frequency))


Move = Callable[[Tensor, Tensor, Tensor], tuple[Tensor, Tensor]]
"""Takes x, y and x^2 + y^2 of rays (x, y, 1), and returns by how much x and y move."""


def _lens(*moves: Move) -> Columns:
    """Return the probe of rays that differ from those of the header."""

    def columns(seen: MisfitPixels) -> Tensor:
        return torch.stack([moved_rays(seen, move) for move in moves], dim=1)

    return columns


def moved_rays(seen: MisfitPixels, move: Move) -> Tensor:
    """Return what it does to the residuals, (M,), metres, that the rays (x, y, 1) move.

    Args:
        seen: The pixels.
        move: Says by how much x and y of each ray move.
    """
    by_x, by_y = move(*_on_image(seen))
    toward = torch.stack([by_x, by_y, torch.zeros_like(by_x)], dim=1) * seen.ray[:, 2:]
    if seen.depth_kind == "radial":
        toward = toward - seen.ray * (toward * seen.ray).sum(dim=1, keepdim=True)
    return (toward * seen.normal).sum(dim=1) * seen.distance


def _focal(x: Tensor, y: Tensor, square: Tensor) -> tuple[Tensor, Tensor]:
    del square
    return x, y


def _aspect(x: Tensor, y: Tensor, square: Tensor) -> tuple[Tensor, Tensor]:
    del square
    return x, -y


def _skew(x: Tensor, y: Tensor, square: Tensor) -> tuple[Tensor, Tensor]:
    del square
    return y, x


def _right(x: Tensor, y: Tensor, square: Tensor) -> tuple[Tensor, Tensor]:
    del y, square
    return torch.ones_like(x), torch.zeros_like(x)


def _down(x: Tensor, y: Tensor, square: Tensor) -> tuple[Tensor, Tensor]:
    del x, square
    return torch.zeros_like(y), torch.ones_like(y)


def _radial(x: Tensor, y: Tensor, square: Tensor) -> tuple[Tensor, Tensor]:
    return x * square, y * square


def _prism_x(x: Tensor, y: Tensor, square: Tensor) -> tuple[Tensor, Tensor]:
    del x, y
    return square, torch.zeros_like(square)


def _prism_y(x: Tensor, y: Tensor, square: Tensor) -> tuple[Tensor, Tensor]:
    del x, y
    return torch.zeros_like(square), square


def _pixel_by_distance(seen: MisfitPixels) -> Tensor:
    (x, y, square), u = _on_image(seen), _standard(seen.distance)
    return _error(seen, x * u, y * u, square * u)


def _target_shape(seen: MisfitPixels) -> Tensor:
    s, t = seen.on_wall.unbind(dim=1)
    return torch.stack([s * s, t * t, s * t], dim=1)


def _plane(seen: MisfitPixels) -> Tensor:
    s, t = seen.on_wall.unbind(dim=1)
    return torch.stack([torch.ones_like(s), s, t], dim=1)


def _room(seen: MisfitPixels) -> Tensor:
    """Return the error by light from all sides: it grows as the direct light falls."""
    return _error(seen, seen.distance**2 / -seen.cosine)


def _facing(seen: MisfitPixels) -> Tensor:
    """Return the error by light that the camera's mount sends back to the wall."""
    return _error(seen, _of_phase(seen, seen.distance) * -seen.cosine / seen.distance**2)


def _circular(seen: MisfitPixels) -> Tensor:
    assert seen.modulation_frequency is not None
    phase = _WAVES * phase_from_radial_distance(seen.distance, seen.modulation_frequency)
    return _error(seen, phase.sin(), phase.cos())


def _amplitude_by_distance(seen: MisfitPixels) -> Tensor:
    return _error(seen, _brightness(seen) * _standard(seen.distance))


def _stray(seen: MisfitPixels) -> Tensor:
    ratio = seen.amplitude.median() / seen.amplitude.clamp(min=1e-12)
    return _error(seen, ratio.clamp(max=_MOST_BRIGHTER))
