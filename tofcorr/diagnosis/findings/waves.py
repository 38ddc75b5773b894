r"""Slow waves over the image: structure of a pose that no filter of the noise makes.

With x and y from 0 to 1 over the image, the residual of every pose has a score for each wave

.. math:: \cos(\pi i x) \cos(\pi j y) ,

beside the pose's own offset and tilts, in units of its standard error. Noise has the same energy in
all of them, whatever its level and however neighbours share it, as long as filters are shorter than
the waves. Structure has not. So the wave with the most energy is compared with the others, an F
test with the poses as units: it needs no floor.

The residual is that of the likely fit. Where poses scatter, an even fit bends the base model
towards their offsets, which leaves waves in every pose that shows a range of distances.
"""

import math
from collections.abc import Sequence
from itertools import product
from typing import NamedTuple

import torch
from scipy import special
from torch import Tensor

from tofcorr.diagnosis.sums.study import Study, likely_residual_of

# Least length of a wave, pixels: filters of 3 to 7 taps leave at least 80 % of the noise's energy
# at it. Derived for a Gaussian of 1.2 pixels.
_LEAST_LENGTH = 16.0
# Most half waves along one side. Chosen to bound the time: 20 waves.
_MOST_HALF_WAVES = 5
# Pixels that are used, at most, evenly spread. Chosen: 50 ms.
_MOST_PIXELS = 100_000
# Combinations of waves with a smaller share of their own square left, beside one another and the
# pose, are not seen by a pose. Chosen: a pose that shows half of the image sees all.
_LEAST_SEEN = 0.05
# Added to the pose's equations, as a share of their diagonal, so that they can be solved for poses
# of few pixels. Chosen, far above rounding.
_RIDGE = 1e-6


class Waves(NamedTuple):
    """Whether waves have unlike energies.

    Attributes:
        p_value: Of the strongest, adjusted for their number.
        square: Mean square that they add beyond what each of them has by noise, m^2.
    """

    p_value: float
    square: float


def unlike_waves(study: Study, chosen: Sequence[str]) -> Waves:
    """Test what a model leaves, fitted by likelihood.

    Args:
        study: The recording.
        chosen: Effects of the model.
    """
    return study.remembered(f"waves beside {', '.join(chosen)}", lambda: _compared(study, chosen))


def _compared(study: Study, chosen: Sequence[str]) -> Waves:
    squares, seen, weight = _energies(study, likely_residual_of(study, chosen))
    own = squares.sum(1) / seen.sum(1).clamp(min=_LEAST_SEEN)
    known = own > 0
    if seen.shape[1] < 2 or not bool(known.any()):
        return Waves(p_value=1.0, square=0.0)
    squares, seen, own, weight = squares[known], seen[known], own[known], weight[known]
    total, numbers = (squares / own[:, None]).sum(0), seen.sum(0)
    energy = total / numbers.clamp(min=_LEAST_SEEN)
    rest = (total.sum() - total) / (numbers.sum() - numbers).clamp(min=_LEAST_SEEN)
    tails = special.fdtrc(
        numbers.numpy(), (numbers.sum() - numbers).numpy(), (energy / rest).numpy()
    )
    beyond = (energy - energy.median()).clamp(min=0).sum()
    p_value = min(1.0, len(total) * float(tails.min()))
    return Waves(p_value=p_value, square=float(beyond * (own / weight).mean()))


def _energies(study: Study, left: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return squared scores of every pose and wave, what is seen of each, and summed weights.

    Args:
        study: The recording.
        left: The residual, shape (M,), metres.

    Returns:
        (U, K), with mean `seen` under white noise of the level assumed; (U, K), 0 to 1; and (U,),
        1 / m^2.
    """
    step = slice(None, None, max(1, len(left) // _MOST_PIXELS))
    observations = study.observations.at(step)
    pose, count = study.system.pose[step], study.system.pose.shape[1]
    columns = torch.cat([pose, _waves(study, step), left[step, None]], dim=1)
    weight = study.weight[step]
    sums = observations.products(columns * weight[:, None], columns)
    size = sums.diagonal(dim1=1, dim2=2).clamp(min=1e-30).sqrt()
    sums = sums / (size[:, :, None] * size[:, None, :])
    across = sums[:, :count, count:]
    inner = sums[:, :count, :count] + _RIDGE * torch.eye(count, dtype=torch.float64)
    sums = sums[:, count:, count:] - across.mT @ torch.linalg.solve(inner, across)
    values, vectors = torch.linalg.eigh(sums[:, :-1, :-1])
    root = torch.where(values > _LEAST_SEEN, values.clamp(min=_LEAST_SEEN).rsqrt(), 0.0)
    white = (vectors * root[:, None, :]) @ vectors.mT
    scores = (white @ sums[:, :-1, -1:])[..., 0] * size[:, -1:]
    seen = (vectors**2 * (root > 0)[:, None, :]).sum(2)
    units = observations.unit[observations.frame]
    whole = torch.zeros(len(scores), dtype=torch.float64).index_add(0, units, weight)
    return scores**2, seen, whole.clamp(min=1e-30)


def _waves(study: Study, step: slice) -> Tensor:
    """Return all waves but a pose's own offset and tilts, (M, K)."""
    camera, inputs = study.inputs.camera, study.inputs
    most = [
        max(1, min(_MOST_HALF_WAVES, int(2 * pixels / _LEAST_LENGTH)))
        for pixels in (camera.width, camera.height)
    ]
    sides = [
        [torch.cos(math.pi * k * (place[step] + 1) / 2) for k in range(count + 1)]
        for place, count in zip((inputs.columns, inputs.rows), most, strict=True)
    ]
    chosen = [
        sides[0][i] * sides[1][j]
        for i, j in product(range(most[0] + 1), range(most[1] + 1))
        if i + j > 1 and (i / most[0]) ** 2 + (j / most[1]) ** 2 <= 1
    ]
    if not chosen:
        return torch.zeros(len(sides[0][0]), 0, dtype=torch.float64)
    return torch.stack(chosen, dim=1)
