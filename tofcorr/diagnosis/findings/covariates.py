"""What a bias may depend on: covariates of every pixel, in bins."""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from tofcorr.conditions import OPTIONAL_CONDITIONS, condition
from tofcorr.diagnosis.sums.study import Study
from tofcorr.simulation.effects.needs import is_clock

# Bins of a covariate. Chosen: few enough that each bin holds many poses.
_BINS = 8
# Values of a covariate that are looked at first. Chosen.
_FEW = 1000


@dataclass(frozen=True, kw_only=True)
class Binned:
    """A covariate in bins.

    Attributes:
        name: Of the covariate.
        edges: Of its bins, in its unit.
        place: Bin of every pixel, shape (M,), int64.
        scaled: The covariate scaled to a range from 0 to 1, shape (M,).
    """

    name: str
    edges: tuple[float, ...]
    place: Tensor
    scaled: Tensor


def binned_covariates(study: Study) -> list[Binned]:
    """Return the covariates that have more than one value, in bins."""
    binned = []
    for name, values in covariates(study).items():
        edges = _edges(values)
        if len(edges) < 3:
            continue
        inner = torch.from_numpy(edges[1:-1])
        span = (values.max() - values.min()).clamp(min=1e-12)
        binned.append(
            Binned(
                name=name,
                edges=tuple(edges.tolist()),
                place=torch.bucketize(values.contiguous(), inner, right=True),
                scaled=(values - values.min()) / span,
            )
        )
    return binned


def covariates(study: Study) -> dict[str, Tensor]:
    """Return what a bias may depend on, for each pixel, by name; units as in the recording."""
    inputs, facts = study.inputs, study.inputs.facts
    camera = inputs.camera
    found = {
        "distance_m": inputs.radial_distance,
        "row": (inputs.rows + 1) / 2 * (camera.height - 1),
        "column": (inputs.columns + 1) / 2 * (camera.width - 1),
        "image_radius": (inputs.rows**2 + inputs.columns**2).sqrt(),
        "incidence_deg": torch.rad2deg(torch.acos(inputs.incidence_cosine.clamp(-1.0, 1.0))),
    }
    if inputs.amplitude is not None:
        found["amplitude"] = inputs.amplitude
    if inputs.modulation_frequency is not None:
        found["phase_quarter_deg"] = torch.rad2deg(torch.remainder(4 * inputs.phase, 2 * torch.pi))
    found |= _of_frames(study)
    if study.observations.recording.moves:
        found["target_x_m"], found["target_y_m"] = inputs.target_xy.unbind(1)
        place = inputs.of_frame(facts.world_from_tool[:, :3, 3])
        found["tool_x_m"], found["tool_y_m"], found["tool_z_m"] = place.unbind(1)
    return {name: values for name, values in found.items() if bool(values.isfinite().all())}


def _of_frames(study: Study) -> dict[str, Tensor]:
    inputs, facts = study.inputs, study.inputs.facts
    known = {}
    if is_clock(facts.timestamp):
        known[condition("timestamp").covariate] = facts.timestamp
    for each in OPTIONAL_CONDITIONS:
        values = getattr(facts, each.name)
        if values is not None:
            known[each.covariate] = each.in_file(values)
    known["frame"] = torch.arange(len(facts.timestamp)).double()
    return {name: inputs.of_frame(values) for name, values in known.items()}


def _edges(values: Tensor) -> np.ndarray:
    """Return edges of bins with equally many pixels; a covariate of few levels gets a bin each."""
    # Of most covariates the first few values already tell that there are many levels.
    levels = np.unique(values[:_FEW].numpy())
    if len(levels) <= _BINS:
        levels = np.unique(values.numpy())
    if len(levels) <= _BINS:
        if len(levels) < 2:
            return levels
        middles = (levels[:-1] + levels[1:]) / 2
        return np.concatenate([levels[:1], middles, levels[-1:]])
    return np.unique(np.quantile(values.numpy(), np.linspace(0, 1, _BINS + 1)))
