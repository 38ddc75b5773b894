r"""What an error that depends on the amplitude may look like where no amplitude was recorded.

The amplitude of a uniform target follows from geometry and exposure,

.. math:: b = \tau \cos\theta / D^2 ,

up to its reflectivity and the vignetting. The base model has no amplitude term then, so its error
would pass for another effect: wiggling, incidence, pixel, lens. The columns b, b^2 and b r^2, for
each target, with r the distance from the image centre, are therefore part of the base model. What
looks like them is not named. What differs within a target, as between the squares of a
checkerboard, stays in the residual.
"""

import torch
from torch import Tensor

from tofcorr.diagnosis.sums.observations import Observations
from tofcorr.simulation.effects.inputs import EffectInputs

# Prior standard deviation of the error at the root mean square of a column, metres. Lindner and
# Kolb (2007) and Fuchs and May (2007) report errors of one to three centimetres by amplitude.
_SIZE = 0.02
# Most targets that get columns of their own; all frames of others share columns. Chosen.
_MOST_TARGETS = 4


def unknown_amplitude_columns(observations: Observations, inputs: EffectInputs) -> Tensor:
    """Return the columns, shape (M, K), metres at one prior standard deviation.

    K is 0 where the amplitude is known.
    """
    if inputs.amplitude is not None:
        return torch.zeros(len(inputs.pixel), 0, dtype=torch.float64)
    bright = inputs.incidence_cosine / inputs.radial_distance.clamp(min=1e-3) ** 2
    exposure = inputs.facts.integration_time
    if exposure is not None and bool((exposure > 0).all()):
        bright = bright * inputs.of_frame(exposure / exposure.mean())
    bright = bright / bright.square().mean().sqrt()
    forms = torch.stack([bright, bright**2, bright * (inputs.rows**2 + inputs.columns**2)], dim=1)
    forms = _SIZE * forms / forms.square().mean(0).sqrt()
    target = inputs.of_frame(_numbered_targets(observations))
    return torch.cat([forms * (target == k)[:, None] for k in target.unique()], dim=1)


def _numbered_targets(observations: Observations) -> Tensor:
    """Return the number of each frame's target, shape (F,); those seen rarely share the last."""
    names = list(observations.recording.frames.target)
    common = sorted(set(names), key=lambda name: (-names.count(name), name))
    last = _MOST_TARGETS - 1
    return torch.tensor([min(common.index(name), last) for name in names])
