"""How well a correction trained on the simulator works on the real camera.

The same correction is trained three times from one half of the poses: on the simulator, on the
simulator with the named effects, and on the recording. It is tested on the other half of the
recording.
"""

from dataclasses import dataclass
from itertools import pairwise
from typing import TypeGuard

import torch
from torch import Tensor, nn
from torch.nn.utils import skip_init

from tofcorr.conditions import OPTIONAL_CONDITIONS
from tofcorr.diagnosis.findings.naming import NamedEffects
from tofcorr.diagnosis.rerun.fitted_simulator import observed_by, solution_of
from tofcorr.diagnosis.rerun.twin import fitted_distance, simulated_frames
from tofcorr.diagnosis.sums.prediction import predicted_distance
from tofcorr.diagnosis.sums.study import Study
from tofcorr.estimation.optimisers import uncompiled
from tofcorr.simulation.options import SimulatorOptions

# Pixels that train a correction; steps, learning rate and width of its network. Chosen so that the
# three corrections take a few seconds.
_TRAINING_PIXELS = 6000
_STEPS = 200
_RATE = 0.02
_HIDDEN = 24
# Added to the diagonal of the base model's system, as a share of its mean, so that it can be
# solved. Chosen, far below the curvature of coefficients that the pixels determine.
_RIDGE = 1e-6
# Unit of the network's output, metres: the size of errors, so that outputs are near one.
_UNIT = 0.01


@dataclass(frozen=True, kw_only=True)
class Transfer:
    """Root mean square errors on held-out real poses in excess of the noise, metres.

    Attributes:
        parametric: Of the base model trained on the simulator, on the simulator with the effects,
            and on real images.
        with_network: The same with a small network on the residual of the base model.
    """

    parametric: tuple[float, float, float]
    with_network: tuple[float, float, float]


def measure_transfer(
    study: Study, named: NamedEffects, given: SimulatorOptions | None, generator: torch.Generator
) -> Transfer:
    """Train on simulated and on real images; test on held-out real ones.

    A fixed pattern of the base model counts as known: it is subtracted from all images.

    Args:
        study: The recording.
        named: The effects named.
        given: The simulator under diagnosis; None: one made from the recording alone.
        generator: Of the split, the noise and the training.
    """
    observations = study.observations
    frames = simulated_frames(observations)
    truth = predicted_distance(observed_by(study, named), solution_of(study, named)[0])
    pattern = _pattern(study)
    real = observations.measured - truth - pattern
    half = torch.randperm(study.system.blocks.num_units, generator=generator)
    training_units = torch.zeros(study.system.blocks.num_units, dtype=torch.bool)
    training_units[half[: study.system.blocks.num_units // 2]] = True
    training = training_units[study.unit_of_pixel] & (study.fit.trust > 0)
    parametric, with_network = [], []
    for model, on_real in ((None, False), (named, False), (named, True)):
        error = real
        distance = observations.measured
        if not on_real:
            distance = fitted_distance(study, model, given, generator, frames)
            pose = solution_of(study, model)[0]
            error = distance - predicted_distance(observed_by(study, model), pose) - pattern
        trained = _Correction(study, distance, error, training & distance.isfinite(), generator)
        parametric.append(_held_out(study, real - trained.parametric(study), ~training))
        with_network.append(_held_out(study, real - trained.full(study), ~training))
    return Transfer(parametric=_triple(parametric), with_network=_triple(with_network))


def _pattern(study: Study) -> Tensor:
    """Return the base model's fixed pattern in each pixel, shape (M,), metres."""
    if study.pattern is None:
        return torch.zeros_like(study.observations.measured)
    return study.pattern.shift(study.inputs, study.pattern.coefficients)


class _Correction:
    """Base model by least squares, and a small network on its residual."""

    def __init__(
        self,
        study: Study,
        distance: Tensor,
        error: Tensor,
        use: Tensor,
        generator: torch.Generator,
    ) -> None:
        places = torch.nonzero(use).reshape(-1)
        if len(places) > _TRAINING_PIXELS:
            picked = torch.randint(0, len(places), (_TRAINING_PIXELS,), generator=generator)
            places = places[picked]
        self._scale: tuple[Tensor, Tensor] | None = None
        columns = study.fit.model.error_columns(distance.nan_to_num(1.0))[places]
        weight = (study.fit.share / (1e-6 + study.fit.sigma**2))[places]
        weight = weight / weight.mean()
        weighted = columns * weight[:, None]
        normal = weighted.T @ columns
        ridge = _RIDGE * float(normal.diagonal().mean()) * torch.eye(len(normal)).double()
        self._coefficients = torch.linalg.solve(normal + ridge, weighted.T @ error[places])
        left = error[places] - columns @ self._coefficients
        inputs = self._inputs(study, distance)[places]
        self._network = _trained(inputs, left, weight, generator)

    def parametric(self, study: Study) -> Tensor:
        """Return the base model's error of the measured pixels, shape (M,), metres."""
        return study.fit.model.error_columns(study.observations.measured) @ self._coefficients

    def full(self, study: Study) -> Tensor:
        """Return the whole predicted error, shape (M,), metres."""
        inputs = self._inputs(study, study.observations.measured)
        with torch.no_grad():
            return self.parametric(study) + self._network(inputs.float()).double()[:, 0] * _UNIT

    def _inputs(self, study: Study, distance: Tensor) -> Tensor:
        """Return what a correction knows at run time, standardised, shape (M, K)."""
        inputs = study.inputs
        known = [distance.nan_to_num(1.0), inputs.rows, inputs.columns]
        if inputs.amplitude is not None:
            known.append(inputs.amplitude.clamp(min=1e-6).log())
        facts = inputs.facts
        of_frames = [getattr(facts, condition.name) for condition in OPTIONAL_CONDITIONS]
        known += [inputs.of_frame(values) for values in of_frames if _varies(values)]
        stacked = torch.stack(known, dim=-1)
        if self._scale is None:
            self._scale = stacked.mean(0), stacked.std(0).clamp(min=1e-12)
        return (stacked - self._scale[0]) / self._scale[1]


def _varies(values: Tensor | None) -> TypeGuard[Tensor]:
    return values is not None and bool(values.isfinite().all()) and float(values.std()) > 0


def _trained(
    inputs: Tensor, left: Tensor, weight: Tensor, generator: torch.Generator
) -> nn.Sequential:
    sizes = (inputs.shape[1], _HIDDEN, _HIDDEN, 1)
    # skip_init: the usual initialisation would draw from the global generator.
    first, second, last = (skip_init(nn.Linear, *pair) for pair in pairwise(sizes))
    network = nn.Sequential(first, nn.Tanh(), second, nn.Tanh(), last)
    with torch.no_grad():
        for layer in network:
            if isinstance(layer, nn.Linear):
                layer.weight.normal_(0.0, layer.in_features**-0.5, generator=generator)
                layer.bias.zero_()
        network[-1].weight.mul_(0.1)  # type: ignore[operator]
    x, y, w = inputs.float(), (left / _UNIT).float()[:, None], weight.float()[:, None]
    optimiser = uncompiled(torch.optim.AdamW)(network.parameters(), lr=_RATE, weight_decay=1e-2)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, _STEPS)
    for _ in range(_STEPS):
        optimiser.zero_grad()
        loss = (w * nn.functional.smooth_l1_loss(network(x), y, reduction="none")).mean()
        loss.backward()
        optimiser.step()
        schedule.step()
    return network


def _held_out(study: Study, error: Tensor, use: Tensor) -> float:
    share = study.fit.share * use
    square = float((share * error**2).sum() / share.sum())
    floor = float((share * study.fit.sigma**2).sum() / share.sum())
    return max(square - floor, 0.0) ** 0.5


def _triple(values: list[float]) -> tuple[float, float, float]:
    return values[0], values[1], values[2]
